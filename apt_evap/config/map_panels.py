"""Maps of a run to draw side by side, from the table [maps] of a TOML file."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from apt_evap._common.validation import check_count, check_number, shown
from apt_evap.config.perturbation_text import read_perturbation, title_of
from apt_evap.config.tables import check_keys, check_table
from apt_evap.detection.limits import MOST_BINS
from apt_evap.emission.energies import TruncatedNormal
from apt_evap.emission.perturbations import Perturbation, RollUp, Unperturbed, to_dict


@dataclass(frozen=True)
class Panel:
    """One map of a picture: the perturbation of its ions, and the title above it."""

    title: str
    perturbation: Perturbation


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
    """

    panels: tuple
    bins: int | None = None
    smoothing: float | None = None

    def to_dict(self) -> dict[str, Any]:
        """Return the settings in plain types, as the table [maps] of a TOML file has them."""
        panels = [{"title": panel.title, "perturbation": to_dict(panel.perturbation)} for panel in self.panels]
        return {"panels": panels, "bins": self.bins, "smoothing": self.smoothing}


def read_maps(table: Mapping[str, Any]) -> MapSettings:
    """Read what maps to draw from a table such as ``[maps]`` of a TOML file.

    Parameters
    ----------
    table : mapping
        bins, smoothing [mm] and panels, a list of tables with a perturbation and a title; nothing has to be there.
        Without panels they are one without perturbation and one of a roll-up with the energies that Shaikh et al.
        (arXiv 2509.13744) find for nickel, 0.155 eV and 0.155 eV.

    Returns
    -------
    MapSettings

    Raises
    ------
    ValueError
        Naming the key, its value and what was expected.
    """
    check_keys(table, ("panels", "bins", "smoothing"))
    bins, smoothing = table.get("bins"), table.get("smoothing")
    if bins is not None:
        bins = check_count(bins, "bins", at_least=1, at_most=MOST_BINS)
    if smoothing is not None:
        smoothing = check_number(smoothing, "smoothing", at_least=0, unit="mm")
    if table.get("panels") is None:
        usual = (Unperturbed(), RollUp(TruncatedNormal(0.155, 0.155)))
        return MapSettings(tuple(Panel(title_of(each), each) for each in usual), bins, smoothing)
    if not isinstance(table["panels"], list) or not table["panels"]:
        raise ValueError(f"panels must be a list of tables such as [[maps.panels]], got {shown(table['panels'])}")
    panels = []
    for number, entry in enumerate(table["panels"], start=1):
        try:
            check_table(entry, "it")
            check_keys(entry, ("title", "perturbation"), ("perturbation",))
            perturbation = read_perturbation(entry["perturbation"])
            title = entry.get("title", title_of(perturbation))
            if not isinstance(title, str):
                raise ValueError(f"title must be text, got {shown(title)}")
        except ValueError as error:
            raise ValueError(f"panel {number}: {error}") from error
        panels.append(Panel(title, perturbation))
    return MapSettings(tuple(panels), bins, smoothing)
