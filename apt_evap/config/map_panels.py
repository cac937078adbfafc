"""Panels of a picture of maps, from the table [maps] of a TOML file."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from apt_evap._common.validation import check_count, check_kind, check_number, check_sequence, short_text
from apt_evap.config.perturbation_text import read_perturbation, title_of
from apt_evap.config.tables import check_keys, check_table
from apt_evap.detection.detector import Detector
from apt_evap.detection.limits import MAX_BINS
from apt_evap.emission.energies import TruncatedNormal
from apt_evap.emission.perturbations import Perturbation, RollUp, Unperturbed, to_dict


@dataclass(frozen=True)
class Panel:
    """One map in a picture.

    Parameters
    ----------
    title : str
        Title above the map.
    perturbation : perturbation
        Perturbation of the ions.

    Raises
    ------
    ValueError
        If the title is not printable text, or the perturbation is invalid.
    """

    title: str
    perturbation: Perturbation

    def __post_init__(self):
        check_kind(self.perturbation, "perturbation", "launch", "a perturbation with a method launch")
        if not isinstance(self.title, str) or not all(part.isprintable() for part in self.title.split("\n")):
            raise ValueError(f"title must be printable text, got {short_text(self.title)}")


@dataclass(frozen=True)
class MapSettings:
    """Maps to draw side by side.

    Parameters
    ----------
    panels : tuple of Panel
        The maps.
    bins : int, optional
        Bins along the longer side.
    smoothing : float, optional
        Standard deviation of the Gaussian that smooths the maps [mm].

    Raises
    ------
    ValueError
        If there is no panel, or a number is outside its range.
    """

    panels: tuple[Panel, ...]
    bins: int | None = None
    smoothing: float | None = None

    def __post_init__(self):
        panels = check_sequence(self.panels, "panels", "Panels")
        if not panels:
            raise ValueError("panels must contain at least one Panel, got none")
        for panel in panels:
            check_kind(panel, "panels", Panel, "Panels")
        object.__setattr__(self, "panels", panels)
        if self.bins is not None:
            object.__setattr__(self, "bins", check_count(self.bins, "bins", at_least=1, at_most=MAX_BINS))
        if self.smoothing is not None:
            object.__setattr__(self, "smoothing", check_number(self.smoothing, "smoothing", at_least=0, unit="mm"))

    def check_detector(self, detector: Detector) -> None:
        """Raise a ValueError, before the simulation, if the smoothing is larger than the detector."""
        if self.smoothing is not None:
            why = "the width of the detector"
            check_number(self.smoothing, "smoothing", at_most=detector.width, unit="mm", why=why)

    def to_dict(self) -> dict[str, Any]:
        """Return the settings in plain types, as in the table [maps] of a TOML file."""
        panels = [{"title": panel.title, "perturbation": to_dict(panel.perturbation)} for panel in self.panels]
        return {"panels": panels, "bins": self.bins, "smoothing": self.smoothing}


def read_maps(table: Mapping[str, Any]) -> MapSettings:
    """Read the settings of maps from a table such as ``[maps]`` of a TOML file.

    Parameters
    ----------
    table : mapping
        bins, smoothing [mm] and panels (a list of tables with a perturbation and a title), all optional. The default
        panels are one without perturbation, and one of a roll-up with the energies of Shaikh et al. (arXiv 2509.13744)
        for nickel, 0.155 eV and 0.155 eV.

    Returns
    -------
    MapSettings

    Raises
    ------
    ValueError
        Names the key, its value and the expected value.
    """
    check_keys(table, ("panels", "bins", "smoothing"))
    bins, smoothing = table.get("bins"), table.get("smoothing")
    if table.get("panels") is None:
        defaults = (Unperturbed(), RollUp(TruncatedNormal(0.155, 0.155)))
        return MapSettings(tuple(Panel(title_of(each), each) for each in defaults), bins, smoothing)
    if not isinstance(table["panels"], list) or not table["panels"]:
        raise ValueError(f"panels must be a list of tables such as [[maps.panels]], got {short_text(table['panels'])}")
    panels = []
    for number, entry in enumerate(table["panels"], start=1):
        try:
            check_table(entry, "it")
            check_keys(entry, ("title", "perturbation"), ("perturbation",))
            perturbation = read_perturbation(entry["perturbation"])
            panels.append(Panel(entry.get("title", title_of(perturbation)), perturbation))
        except ValueError as error:
            raise ValueError(f"panel {number}: {error}") from error
    return MapSettings(tuple(panels), bins, smoothing)
