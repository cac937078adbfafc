"""What an instrument sees of a run: hits of its ions at the operating voltage, behind the lens, in the field of view.

A run is the table of what evaporated. Its observation has the voltages (`SimulatedVoltage` or `RealVoltage`), the lens
(`FreeSpecimen` or `RunLens`), the detector, and the field of view of the flights, which is unlimited if all ions fly.
"""

import math
from dataclasses import replace
from functools import cached_property
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from apt_evap._common.codec import to_plain
from apt_evap._common.small_matrices import squared_lengths
from apt_evap._common.types import Booleans, Floats
from apt_evap._common.validation import check_kind, check_switch, short_text
from apt_evap.detection.detector import Detector
from apt_evap.detection.detector_map import DetectorMap
from apt_evap.detection.hits import Hits, Outcome
from apt_evap.detection.instrument import Instrument
from apt_evap.detection.microscope.free_specimen import FreeSpecimen
from apt_evap.detection.microscope.local_electrode import LocalElectrode
from apt_evap.detection.microscope.run_lens import RadiusHistory, RunLens
from apt_evap.emission.emissions import TangentialLaunches
from apt_evap.emission.perturbations import Perturbation, Unperturbed, described, perturbation_text, warn_if_not_for
from apt_evap.simulation.columns import Flown
from apt_evap.simulation.flight.field_of_view import stereographic_rim
from apt_evap.simulation.operating_voltage import RealVoltage, SimulatedVoltage
from apt_evap.simulation.run_table import RunTable
from apt_evap.warnings import RunWarning, warn

_RIM_SAMPLES = 16  # ions, and azimuths, for which the rim of the field of view is followed to a detector
_Table = TypeVar("_Table", bound=RunTable)  # or a run
_UNITS = {"charge": "e", "field": "V/nm", "charge_state": "e"}


class Observation:
    """Hits, maps and records of a run.

    Parameters
    ----------
    run : RunTable
        The table of the run.
    """

    def __init__(self, run: RunTable) -> None:
        self.run = run
        self.detector = run.detector
        self.operating: SimulatedVoltage | RealVoltage = SimulatedVoltage(run)
        """Voltages, charges and masses in flight."""
        if run.units is not None and run.real is not None:  # both or none
            self.operating = RealVoltage(run, run.units, run.real)

    def __repr__(self) -> str:
        return f"<Observation: {self.run!r}>"

    @cached_property
    def lens(self) -> RunLens | FreeSpecimen:
        """What becomes of the directions and times of the flights in the instrument."""
        return self.run.lens or FreeSpecimen()

    @property
    def rim(self) -> float:
        """Largest length of the stereographic directions of flights that count; infinite if all do."""
        angle = self.run.field_of_view
        return math.inf if angle is None else stereographic_rim(angle)

    # ---- hits ------------------------------------------------------------------------------------------------------

    def hits(self, perturbation: Perturbation, by_response: bool = False) -> Hits:
        """Hits of the ions for a perturbation, see `Run.hits`."""
        run = self.run
        check_switch(by_response, "by_response")
        x, y, times, outcome = self._impacts(*self._flights(perturbation, by_response))
        extra = self.operating.truth()
        units = {name: _UNITS[name] for name in extra}
        extra["element"] = np.array(run.elements)[run.species]
        if len(run.phase_names) > 1:
            extra["phase_name"] = np.array(run.phase_names)[run.phase]
        return Hits(
            x=x,
            y=y,
            **self.operating.columns(times, outcome),
            positions=run.emissions.positions,
            site=run.site,
            ion=run.emissions.ions,
            outcome=outcome,
            extra=extra,
            units=units,
            source=f"simulation, {perturbation_text(perturbation)}",
            extent=self.detector.extent if self._sees_whole_detector else None,
        )

    def places(self, perturbation: Perturbation, by_response: bool = False) -> tuple[Floats, Floats, NDArray[np.int8]]:
        """Positions of the hits [mm] and outcomes, see `Run.places`."""
        check_switch(by_response, "by_response")
        x, y, _, outcome = self._impacts(*self._flights(perturbation, by_response))
        return x, y, outcome

    def _flights(self, perturbation: Perturbation, by_response: bool = False) -> tuple[Floats, Floats, Booleans]:
        """Stereographic directions (n, 2), times of flight (n,) and ions that were not flown, for a perturbation."""
        run, operating = self.run, self.operating
        present = np.flatnonzero(np.bincount(run.species, minlength=len(run.elements)))
        elements = list(dict.fromkeys(run.elements[species] for species in present))  # phases may share an element
        warn_if_not_for(dict(run.settings.get("rule") or {}).get("name"), perturbation, elements)
        for flown_as, flown in zip(run.perturbations, run.flown, strict=True):
            known = flown_as == perturbation or flown_as == described(perturbation)  # by name and repr in a file
            if known and not by_response and (operating.energies_as_flown or perturbation == Unperturbed()):
                return flown.directions, flown.times, np.zeros(len(run), bool)
        if not callable(getattr(perturbation, "tangential", None)):
            check_kind(perturbation, "perturbation", "launch", "a perturbation such as Unperturbed() or RollUp(0.2)")
            raise ValueError(
                f"perturbation {short_text(perturbation)} was not flown in this run and has no method `tangential`; "
                "pass it to the simulation: simulation.run(n, emissions=[...])"
            )
        if run.responses is None:
            raise ValueError(f"this run has no responses and {short_text(perturbation)} was not flown in it")
        emissions, random = run.emissions, run.ion_random.from_start()
        launches = TangentialLaunches(*perturbation.tangential(emissions, random))  # type: ignore[attr-defined]
        # the responses are functions of the energies at the simulated voltage
        scales = operating.energy_scales
        factors, scale = np.sqrt(scales), float(np.median(scales)) if len(run) else 1.0
        launches = launches._replace(first=launches.first * factors, second=launches.second * factors)
        directions, times = run.response_model.evaluate(run.responses, launches, emissions.masses, scale)
        return directions, times, run.not_flown

    def _impacts(self, directions, times, not_flown):
        """Positions, times and outcomes on the detector, of flights that end within the field of view."""
        outside = (squared_lengths(directions) > self.rim**2) | not_flown
        directions, times = np.where(outside[:, None], np.nan, directions), np.where(outside, np.nan, times)
        *columns, outcome = self.detector.impacts(*self._seen(directions, times))
        outcome[outside] = Outcome.OUTSIDE
        return *columns, outcome

    def _seen(self, directions, times, rows=slice(None)):
        """Directions and times in the instrument, of those of the simulated flights of these rows."""
        operating, emissions = self.operating, self.run.emissions
        masses = operating.masses[rows]
        # t is proportional to sqrt(m / (n V)) on the same path
        times = times * np.sqrt(operating.energy_scales[rows] * (masses / emissions.masses[rows]))
        return self.lens.seen(
            directions,
            times,
            emissions.ions[rows],
            masses,
            operating.charges[rows],
            operating.flight_voltages[rows],
            operating.instrument_flight_voltages[rows],
            self.detector.distance,
        )

    # ---- field of view ---------------------------------------------------------------------------------------------

    @cached_property
    def seen_rim(self) -> float:
        """Least length of the stereographic directions in which ions at the rim of the field of view arrive."""
        n = len(self.run)
        if math.isinf(self.rim) or not n:
            return math.inf
        rows = np.unique(np.linspace(0, n - 1, _RIM_SAMPLES).astype(int))
        rim = np.tile([self.rim, 0.0], (len(rows), 1))
        return float(np.sqrt(squared_lengths(self._seen(rim, np.ones(len(rows)), rows)[0])).min())

    @property
    def _sees_whole_detector(self):
        return self.seen_rim >= stereographic_rim(self.detector.half_angle)

    def grid(self, bins: int) -> DetectorMap:
        """Empty map of the complete detector, see `Run.grid`."""
        grid = self.detector.grid(bins)
        if self._sees_whole_detector:
            return grid
        x, y = ((edges[1:] + edges[:-1]) / 2 for edges in (grid.x_edges, grid.y_edges))
        places = np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)
        angles = self.detector.seen_from_apex.angles(places).reshape(grid.values.shape)
        mask = np.tan(angles / 2) <= self.seen_rim
        return DetectorMap.from_array(grid.values, grid.x_edges, grid.y_edges, mask, is_counts=True)

    def _rim_on(self, instrument):
        """Least distance from the centre of an instrument at which ions at the rim arrive [mm]."""
        azimuths = 2 * np.pi * np.arange(_RIM_SAMPLES) / _RIM_SAMPLES
        radius = 2 * self.seen_rim / (1 - self.seen_rim**2) * instrument.distance
        places = instrument.places(radius * np.column_stack([np.cos(azimuths), np.sin(azimuths)]))
        return np.nanmin(np.hypot(*places.T), initial=math.inf) * (1 + 1e-6)

    def warn_if_beyond(self, sees_more: bool, device: str) -> None:
        """Warn if there are directions within those of a device that are outside the field of view of the flights."""
        if sees_more:
            warn(
                f"the {device} sees ions outside the field of view of the flights ({self.run.field_of_view:.4g} "
                "degrees), which are missing: run with a larger field_of_view (FlightSettings, or [flights] in a "
                "settings file)",
                RunWarning,
            )

    # ---- instruments -----------------------------------------------------------------------------------------------

    def record(self, instrument: Instrument, perturbation: Perturbation, seed: int) -> Hits:
        """Ions that an instrument records, see `Run.record`."""
        check_kind(instrument, "instrument", Instrument, "an Instrument")
        run, units = self.run, self.operating.require_units("an instrument")
        # errors of the times of an instrument replace those of the run
        units = units if instrument.timing is None else replace(units, timing=None)
        plane = replace(run, units=units, detector=replace(self.detector, projection="plane"))
        hits = Observation(plane).hits(perturbation)
        self.warn_if_beyond(
            self.seen_rim < 1.0 and self._rim_on(instrument) < instrument.field_of_view / 2, "instrument"
        )
        truth = {"species": run.species}
        if len(run.phase_names) > 1:
            truth["phase"] = run.phase
        hits = replace(hits, extra=hits.extra | truth)
        return instrument.hits(hits, self.detector.distance, seed=seed)


def behind(run: _Table, lens: LocalElectrode) -> _Table:
    """The same run with a lens."""
    check_kind(lens, "lens", LocalElectrode, "a LocalElectrode")
    history = RadiusHistory(run.cap.ions, run.cap.radii, run.cap.apexes)
    imaged = RunLens.of(lens, run.settings["tip"], history, run.emissions.nearest_neighbour_distance)
    return replace(run, settings=run.settings | {"microscope": to_plain(imaged)})


def on_detector(run: _Table, detector: Detector, lens: LocalElectrode | None) -> _Table:
    """The same ions on another detector, see `Run.on_detector`."""
    check_kind(detector, "detector", Detector, "a Detector")
    if lens is not None:
        before = Observation(run)
        run = behind(run, lens)
        before.operating.check_lens(lens, before.lens.lens)
    run = _with_detector(run, detector)
    edge = stereographic_rim(detector.polar_angle(detector.width / 2))
    observation = Observation(run)
    observation.warn_if_beyond(observation.seen_rim < edge * (1 - 1e-6), "detector")
    return run


def _with_detector(run, detector):
    """The same run with another detector, whose distance changes the times of flight."""
    ratio = detector.distance / run.detector.distance
    flown, responses = run.flown, run.responses
    if ratio != 1.0:
        flown = tuple(Flown(flights.directions, flights.times * ratio) for flights in flown)
        if responses is not None:
            factors = np.array([1.0, 1.0, ratio], np.float32)[:, None]  # directions and time
            site, rolled = responses.site * factors, responses.rolled * factors
            responses = replace(responses, site=site, rolled=rolled, residuals=responses.residuals * ratio)
    settings = run.settings | {"detector": to_plain(detector)}
    return replace(run, detector=detector, settings=settings, flown=flown, responses=responses)
