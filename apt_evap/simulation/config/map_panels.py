"""Panels of a picture of maps, from the table [maps] of a TOML file."""

from typing import Any

from apt_evap._common.codec import checked, count, from_plain, is_plain, number, settings
from apt_evap._common.validation import check_kind, check_number, check_sequence, short_text
from apt_evap.detection.binning import MAX_BINS
from apt_evap.detection.detector import Detector
from apt_evap.emission.energies import TruncatedNormal
from apt_evap.emission.perturbations import RollUp, Unperturbed
from apt_evap.simulation.config.perturbation_text import read_perturbation, title_of


def _title(title, name):
    if not isinstance(title, str) or not all(part.isprintable() for part in title.split("\n")):
        raise ValueError(f"{name} must be printable text, got {short_text(title)}")
    return title


def _launches(perturbation, name):
    return check_kind(perturbation, name, "launch", "a perturbation with a method launch")


def _panels(panels, name):
    panels = check_sequence(panels, name, "Panels")
    if not panels:
        raise ValueError(f"{name} must contain at least one Panel, got none")
    return tuple(check_kind(panel, name, Panel, "Panels") for panel in panels)


def _read_panels(tables, name):
    if not isinstance(tables, list):
        raise ValueError(f"{name} must be a list of tables such as [[maps.panels]], got {short_text(tables)}")
    panels = []
    for place, table in enumerate(tables, start=1):
        try:
            panels.append(from_plain(table, Panel, what="it"))
        except ValueError as error:
            raise ValueError(f"panel {place}: {error}") from error
    return panels


@settings
class Panel:
    """One map in a picture."""

    perturbation: Any = checked(
        "Perturbation of the ions.",
        "perturbation",
        _launches,
        read=lambda plain, name: read_perturbation(plain) if is_plain(plain) else plain,
    )
    title: str = checked("Title above the map; by default from the perturbation.", "str", _title, default=None)

    def _check(self):
        return {"title": title_of(self.perturbation) if self.title is None else self.title}


@settings
class MapSettings:
    """Maps to draw side by side, and the table ``[maps]`` of a settings file."""

    panels: tuple[Panel, ...] = checked(
        "The maps. By default one without perturbation, and one of a roll-up with the energies of Shaikh et al. (arXiv "
        "2509.13744) for nickel, 0.155 eV and 0.155 eV.",
        "tuple of Panel",
        _panels,
        default=(Panel(Unperturbed()), Panel(RollUp(TruncatedNormal(0.155, 0.155)))),
        read=_read_panels,
    )
    bins: int | None = count("Bins along the longer side.", default=None, at_least=1, at_most=MAX_BINS)
    smoothing: float | None = number(
        "Standard deviation of the Gaussian that smooths the maps.", default=None, at_least=0, unit="mm"
    )

    def check_detector(self, detector: Detector) -> None:
        """Raise a ValueError, before the simulation, if the smoothing is larger than the detector."""
        if self.smoothing is not None:
            why = "the width of the detector"
            check_number(self.smoothing, "smoothing", at_most=detector.width, unit="mm", why=why)
