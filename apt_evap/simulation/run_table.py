"""The table of what evaporated: the fields of a run, and what follows from them alone."""

from dataclasses import dataclass, field, fields
from functools import cached_property
from typing import Any

import numpy as np

from apt_evap._common.codec import check_itself, from_plain
from apt_evap._common.ion_random import IonRandom
from apt_evap._common.notebook import as_table
from apt_evap._common.types import Booleans, Floats
from apt_evap.detection.detector import Detector
from apt_evap.detection.microscope.run_lens import RunLens
from apt_evap.emission.emissions import Emissions
from apt_evap.emission.perturbations import Unperturbed, perturbation_text
from apt_evap.evaporation.state import EmitterState
from apt_evap.simulation.columns import Clock, Column, every_column_of, fingerprint_of
from apt_evap.simulation.flight.response import ResponseModel, Responses, ResponseSettings
from apt_evap.simulation.history import CapHistory, History
from apt_evap.simulation.provenance import provenance_now
from apt_evap.simulation.real_units import RealColumns, RealUnits


@dataclass(frozen=True, eq=False, repr=False)
class RunTable:
    """What evaporated, with one row per ion, and the settings of the run; the fields are described at `Run`."""

    emissions: Emissions
    site: np.ndarray
    species: np.ndarray
    charges: np.ndarray
    fields: np.ndarray
    perturbations: tuple
    flown: tuple
    responses: Responses | None
    seed: int
    voltage: float
    detector: Detector
    response_settings: ResponseSettings
    elements: tuple
    settings: dict
    history: History = field(default_factory=History.empty)
    state: EmitterState | None = None
    first_event: int = 0
    ended: str = ""
    provenance: dict = field(default_factory=provenance_now)
    detached: Any = None
    phase: Any = None
    cap: CapHistory = field(default_factory=CapHistory.empty)
    clock: Clock | None = None
    events: dict[str, np.ndarray] = field(default_factory=dict)
    units: RealUnits | None = None
    real: RealColumns | None = None

    def __post_init__(self):
        check_itself(self)

    def _check(self):
        of_all = {"detached": bool, "phase": np.int8}
        return {name: np.zeros(len(self.site), kind) for name, kind in of_all.items() if getattr(self, name) is None}

    def __getstate__(self) -> dict[str, Any]:
        """The fields alone, for copies: what was computed from them is computed again."""
        return {item.name: getattr(self, item.name) for item in fields(self)}

    def __len__(self) -> int:
        return len(self.site)

    @property
    def every_column(self) -> list[Column]:
        """The columns of this run, see `apt_evap.simulation.columns`."""
        return every_column_of(self)

    _repr_html_ = as_table

    def __repr__(self) -> str:
        flown = ", ".join(perturbation_text(perturbation) for perturbation in self.perturbations)
        responses = "" if self.responses is None else f"responses, {self.flagged.sum():,} of them flagged"
        if not_flown := int(self.not_flown.sum()):
            responses += f"; {not_flown:,} ions not flown"
        details = "; ".join(part for part in (responses, flown and f"flown: {flown}", self.ended) if part)
        elements = ", ".join(dict.fromkeys(self.elements))
        return f"<Run: {len(self):,} ions of {elements} at {self._voltage_text()}; {details}>"

    def _voltage_text(self):
        """The simulated voltage; in real units the voltages, and the operating field."""
        if self.units is None or self.real is None or not len(self):
            return f"{self.voltage:g} V"
        low, high = (f"{voltage:.4g}" for voltage in (self.real.voltages.min(), self.real.voltages.max()))
        voltages = low if low == high else f"{low} to {high}"
        return f"{voltages} V, {self.units.operating_field:.3g} V/nm at the {self.units.field_reference}"

    @property
    def phase_names(self) -> tuple[str, ...]:
        """Names of the phases of the specimen; ("matrix",) if there is only one."""
        return tuple(phase["name"] for phase in self.settings["tip"].get("phases", ())) or ("matrix",)

    @property
    def evaporation_fields(self) -> Floats:
        """Evaporation field of the species of each ion [V/nm], shape (n,)."""
        tip = self.settings["tip"]
        # in the order of the species; two of them may have the same name
        materials = tip.get("elements") or [tip["material"], *(material for material, _ in tip["solutes"])]
        return np.array([material["evaporation_field"] for material in materials])[self.species]

    @cached_property
    def lens(self) -> RunLens | None:
        """The lens in front of the specimen; None for a specimen in free space."""
        plain = self.settings.get("microscope")
        return None if plain is None else from_plain(plain, RunLens, what="microscope")

    @property
    def field_of_view(self) -> float | None:
        """Largest polar angle of the flights that count [degrees]; None if all do, see `FlightSettings`."""
        return self.settings.get("flights", {}).get("field_of_view")

    @property
    def not_flown(self) -> Booleans:
        """Ions without responses, because they cannot arrive in the field of view of the flights, bool (n,)."""
        if self.responses is None or self.responses.not_flown is None:
            return np.zeros(len(self), bool)
        return self.responses.not_flown

    @property
    def response_model(self) -> ResponseModel:
        """Launches, fit and evaluation of the responses."""
        return ResponseModel(self.response_settings, self.detector)

    @property
    def flagged(self) -> Booleans:
        """Ions whose responses deviate from their own flights by more than the bound, or have no fit, bool (n,)."""
        if self.responses is None:
            return np.zeros(len(self), bool)
        return self.response_model.flagged(self.responses, self.emissions)

    @property
    def first_perturbation(self) -> Any:
        """The first perturbation flown in the run; `Unperturbed` if there are only responses."""
        return self.perturbations[0] if self.flown else Unperturbed()

    @cached_property
    def ion_random(self) -> IonRandom:
        """Random numbers of the ions, the same for every perturbation."""
        return IonRandom(self.seed, self.emissions.ions)

    def require_responses(self, name: str = "run") -> Responses:
        """Responses of the run; ValueError, which begins with this name of the run, if there are none."""
        if self.responses is None:
            raise ValueError(
                f"{name} must have responses, got {self!r}: repeat it with responses=True, or responses = true in "
                "[simulation] of its settings file"
            )
        return self.responses

    def fingerprint(self) -> str:
        """Hash of all results, to compare runs.

        Returns
        -------
        str
            SHA-256 over the names, types and values of the columns: emissions, sites, species, charges, fields, times
            and voltages of a control, flown perturbations and responses, but not the real units, which follow from
            them. By design it does not depend on the machine.
        """
        return fingerprint_of(self)
