"""The indexing of a twin, as the file start.json keeps it."""

from typing import Any

from apt_evap._common.codec import checked, choice, from_plain, number, settings, vector
from apt_evap._common.validation import check_kind, check_sequence


def _text(value, name):
    return check_kind(value, name, str, "a text")


def _texts(value, name):
    return tuple(_text(line, name) for line in check_sequence(value, name, "texts"))


def _candidates(value, name):
    if not value:
        raise ValueError(f"{name} must have at least one candidate, got none")
    return tuple(value)


def _read_candidates(plain, name):
    return [
        from_plain(candidate, CandidateRecord, what="a candidate")
        for candidate in check_sequence(plain, name, "tables")
    ]


@settings
class CandidateRecord:
    """A candidate, as it is in start.json."""

    axis: tuple = vector("Crystal direction along the axis of the specimen", 3)
    rotation: float = number("Rotation about the axis", unit="degrees")
    scale: float = number("Scale of the map", above=0, unit="mm/rad")
    centre: tuple = vector("Place of the axis", 2, unit="mm")
    score: float = number("Explained fraction of the structure", at_least=0, at_most=1)
    confidence: float = number("Confidence", at_least=0, at_most=1)
    rolled: float = number("Part of the pattern of ions that roll up", at_least=0, at_most=1)
    contrast: float = number("Sum of the amplitudes", at_least=0)
    angle_error: float = number("Standard error of the orientation", at_least=0, unit="degrees")
    pattern_radius: float = number("Radius of the tip of the pattern", above=0, unit="nm")
    barrel: float = number("Barrel term of the lens", default=0.0, unit="1/rad^2")
    rim_change: float = number("Relative change of the scale from the centre to the rim", default=0.0)
    scale_error: float | None = number("Standard error of the scale", default=None, at_least=0, unit="mm/rad")


@settings
class IndexingRecord:
    """Result of the first step, as it is in start.json."""

    verdict: str = choice("Verdict of the indexing", ("indexed", "undecided"))
    reason: str = checked("Reason of the verdict", "str", _text)
    simulated_radius: float = number("Radius of the simulated tip", above=0, unit="nm")
    candidates: tuple = checked("Candidates", "tuple", _candidates, read=_read_candidates)
    deciding_marks: tuple = checked("Marks that would decide", "tuple", _texts, read=lambda plain, _: plain)
    radii: Any = checked("Radii of the specimen, which are in the settings, too", "list", lambda radii, _: radii)

    @property
    def best(self) -> CandidateRecord:
        """The first candidate."""
        return self.candidates[0]
