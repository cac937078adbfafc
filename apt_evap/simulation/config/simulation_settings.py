"""Settings of a simulation, from which its specimen and the simulation are built."""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from apt_evap._common.codec import to_plain
from apt_evap._common.files import sha256_of
from apt_evap._common.validation import check_count, check_kind, check_seed, check_switch, short_text
from apt_evap.detection.detector import Detector
from apt_evap.detection.microscope.local_electrode import LocalElectrode
from apt_evap.detection.microscope.run_lens import field_of_view
from apt_evap.emission.perturbations import Perturbation, Unperturbed
from apt_evap.evaporation.cap import doubt_of_cap
from apt_evap.evaporation.charge_settings import ChargeSettings
from apt_evap.evaporation.law import Law, check_law
from apt_evap.evaporation.rule import CompiledRule, Rule, check_rule
from apt_evap.evaporation.voltage import VoltageControl, check_voltage
from apt_evap.io.specimens import read_tip
from apt_evap.simulation.config.map_panels import MapSettings
from apt_evap.simulation.config.tables import located
from apt_evap.simulation.flight.flight_pool import WHOLE_DETECTOR, FlightSettings
from apt_evap.simulation.flight.response import ResponseSettings
from apt_evap.simulation.monitor import Monitor
from apt_evap.simulation.real_units import OperatingPoint, check_flight_charges
from apt_evap.simulation.run import Run
from apt_evap.simulation.simulation import Simulation
from apt_evap.specimen.materials import Material
from apt_evap.specimen.tip import Tip

_KINDS = {
    "path": Path,
    "tip": Mapping,
    "detector": Detector,
    "charge_settings": ChargeSettings,
    "flight_settings": FlightSettings,
    "response_settings": ResponseSettings,
    "monitor": Monitor,
    "maps": MapSettings,
}


@dataclass(frozen=True, repr=False)
class Config:
    """Settings of a simulation from a TOML file; made by `read_config`.

    Parameters
    ----------
    path : Path
        The file.
    tip : dict
        Arguments of `Tip`, or of `read_tip` if there is a "path".
    n_ions : int
        Number of atoms to evaporate.
    responses : bool
        Whether to compute responses. Perturbations of the maps that need their own flights are flown.
    voltage : float
        Applied voltage [V].
    seed : int
        Seed of the random numbers of the perturbations.
    detector : Detector
        The detector.
    charge_settings, flight_settings, response_settings : ChargeSettings, FlightSettings, ResponseSettings
        Accuracy of the computation.
    monitor : Monitor
        Monitoring of the run.
    maps : MapSettings
        Maps of the run.
    output : str or None
        File name of the run.
    law : law
        Selects the next atom to evaporate.
    control : VoltageControl or None
        Rate, pulses and control of the voltage.
    real_units : OperatingPoint or None
        Argument of `Run.at_evaporation_field`; None: the run is saved at the simulated voltage.
    rule : charging rule
        Distribution of the charge over the surface.
    microscope : LocalElectrode or None
        Lens in front of the specimen, for `Run.at_evaporation_field`.
    key : str
        Result of `key_of` for the content of the file.

    Raises
    ------
    ValueError
        If a field has the wrong type or is outside its range, or the maps do not fit the detector.
    """

    path: Path
    tip: dict
    n_ions: int
    responses: bool
    voltage: float
    seed: int
    detector: Detector
    charge_settings: ChargeSettings
    flight_settings: FlightSettings
    response_settings: ResponseSettings
    monitor: Monitor
    maps: MapSettings
    output: str | None
    law: Law
    control: VoltageControl | None
    real_units: OperatingPoint | None
    rule: Rule | CompiledRule
    microscope: LocalElectrode | None
    key: str = ""

    def __post_init__(self):
        for name, kind in _KINDS.items():
            check_kind(getattr(self, name), name, kind, f"of type {kind.__name__}")
        check_count(self.n_ions, "n_ions", at_least=1)
        check_switch(self.responses, "responses")
        check_voltage(self.voltage)
        check_seed(self.seed)
        if self.output is not None and not (isinstance(self.output, str) and self.output):
            raise ValueError(f"output must be a file name such as 'run.h5', got {short_text(self.output)}")
        self.maps.check_detector(self.detector)
        if self.real_units is not None and not self.responses:
            for perturbation in self.emissions:  # energies are those of an experiment, the flight would be at 1000 V
                if perturbation != Unperturbed():
                    raise ValueError(
                        f"[simulation] responses must be true for maps of {short_text(perturbation)} in real units"
                    )
        check_law(self.law)
        check_rule(self.rule)

    def __repr__(self) -> str:
        panels = ", ".join(panel.title for panel in self.maps.panels)
        if "path" in self.tip:
            specimen = f"from {str(self.tip['path'])!r}"
        else:
            specimen = f"of {host_of(self.tip).name}, apex radius {self.tip['apex_radius']:.4g} nm"
        return f"<Config {str(self.path)!r}: {self.n_ions:,} ions {specimen}; maps: {panels}>"

    @property
    def emissions(self) -> tuple[Perturbation, ...]:
        """Perturbations of the maps with their own flights: those for which the run has no responses."""
        perturbations: list[Perturbation] = []  # one of a user may have no hash
        for panel in self.maps.panels:
            by_response = self.responses and callable(getattr(panel.perturbation, "tangential", None))
            if not by_response and panel.perturbation not in perturbations:
                perturbations.append(panel.perturbation)
        return tuple(perturbations)

    def specimen(self) -> Tip:
        """Build the specimen, or read it from its file.

        Raises
        ------
        FileError
            If it is impossible, or its file cannot be read or has another SHA-256 than the settings.
        """
        with located(self.path, "tip"):
            if "path" not in self.tip:
                return Tip(**self.tip)
            settings = dict(self.tip)
            expected = settings.pop("sha256", None)
            if expected is not None and (digest := sha256_of(settings["path"])) != expected:
                raise ValueError(
                    f"{str(settings['path'])!r} has changed: expected sha256 {short_text(expected)}, got {digest!r}"
                )
            try:
                return read_tip(**settings)
            except ImportError as error:  # a format that needs another package
                raise ValueError(str(error)) from error

    def simulation(self, *, n_threads: int | None = None) -> Simulation:
        """Build the specimen and the simulation.

        Parameters
        ----------
        n_threads : int, optional
            Number of threads; by default the number of processors that this process may use.

        Returns
        -------
        Simulation

        Raises
        ------
        FileError
            If the specimen is impossible, or the flights do not fit the specimen; the message names the file.
        """
        tip = self.specimen()
        if self.real_units is not None:
            with located(self.path, "real_units"):
                names = tuple(element.name for element in tip.elements)
                check_flight_charges(self.real_units.flight_charges, names)
        with located(self.path):  # flights and tip or detector: no single table
            flight_settings = self.flight_settings
            if self.microscope is not None and flight_settings.field_of_view == WHOLE_DETECTOR:
                angle = field_of_view(self.microscope, tip, self.detector)
                flight_settings = replace(flight_settings, field_of_view=angle)
            simulation = Simulation(
                tip,
                voltage=self.voltage,
                seed=self.seed,
                detector=self.detector,
                charge_settings=self.charge_settings,
                flight_settings=flight_settings,
                response_settings=self.response_settings,
                monitor=self.monitor,
                n_threads=n_threads,
                law=self.law,
                rule=self.rule,
                control=self.control,
            )
        with located(self.path, "real_units" if self.microscope is None else "microscope"):
            self._check_cap(simulation)
        return simulation

    def _check_cap(self, simulation):
        """Raise a ValueError, before the simulation, if real units need a cap and there is none."""
        if self.real_units is None and self.microscope is None:
            return
        reference = (self.real_units or OperatingPoint()).field_reference
        if reference == "cap":
            doubt = doubt_of_cap(simulation.emitter.cap.radius, simulation.tip.settings.get("apex_radius"))
            if doubt:
                raise ValueError(doubt)

    def with_origin(self, run: Run) -> Run:
        """The run with the name of this file, its maps and its key in the provenance."""
        origin = {"config": self.path.name, "maps": to_plain(self.maps), "settings": self.key}
        return replace(run, provenance=run.provenance | origin)

    def as_saved(self, run: Run) -> Run:
        """The run as it is saved: with its origin, and in real units if the file has a table for them.

        Raises
        ------
        FileError
            If it cannot be converted; the message names the file.
        """
        run = self.with_origin(run)
        if self.real_units is None and self.microscope is None:
            return run
        with located(self.path, "real_units" if self.microscope is None else "microscope"):
            return run.at_evaporation_field(self.microscope, self.real_units)


def host_of(tip: Mapping[str, Any]) -> Material:
    """Material, or that of the matrix."""
    return tip["phases"][0].material if "phases" in tip else tip["material"]
