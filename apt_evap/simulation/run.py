"""A run: the sequence of evaporated atoms and the hit positions of their ions for any perturbation; saved in HDF5."""

import hashlib
import json
import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from apt_evap._common.codec import changed, from_plain, to_plain
from apt_evap._common.ion_random import IonRandom
from apt_evap._common.notebook import as_table
from apt_evap._common.small_matrices import squared_lengths
from apt_evap._common.types import AnyPath, Booleans, Floats, Integers
from apt_evap._common.validation import (
    check_kind,
    check_seed,
    check_sequence,
    check_switch,
    short_text,
)
from apt_evap.detection.detector import Detector
from apt_evap.detection.detector_map import DetectorMap
from apt_evap.detection.hits import Hits, Outcome
from apt_evap.detection.instrument import Instrument
from apt_evap.detection.microscope.local_electrode import LocalElectrode
from apt_evap.detection.microscope.run_lens import RadiusHistory, RunLens
from apt_evap.emission.emissions import Emissions, TangentialLaunches
from apt_evap.emission.perturbations import Perturbation, Unperturbed, described, warn_if_not_for
from apt_evap.evaporation.state import EmitterState
from apt_evap.simulation.columns import (
    ALWAYS,
    OPTIONAL,
    Clock,
    Column,
    Flown,
    check_sequence_of_ions,
    columns_of,
    flown_columns,
    parts_of,
    response_columns,
    target_columns,
)
from apt_evap.simulation.flight.field_of_view import stereographic_rim
from apt_evap.simulation.flight.response import ResponseModel, Responses, ResponseSettings
from apt_evap.simulation.history import CapHistory, History
from apt_evap.simulation.provenance import joined, provenance_now
from apt_evap.simulation.real_units import OperatingPoint, RealColumns, RealUnits, in_real_units, random_of
from apt_evap.simulation.run_hdf5 import read_run, write_run
from apt_evap.warnings import RunWarning, warn

_RIM_SAMPLES = 16  # ions, and azimuths, for which the rim of the field of view is followed to a detector


@dataclass(frozen=True, eq=False, repr=False)
class Run:
    """Sequence of evaporated atoms, with the data for the hit positions of their ions.

    Returned by `Simulation.run` and `load`.

    Parameters
    ----------
    emissions : Emissions
        Sites, normals, neighbours, charge states, masses and numbers of the n ions.
    site : ndarray of int64, shape (n,)
        Index of each atom in the specimen.
    species : ndarray of int32, shape (n,)
        Index of each atom into `elements`.
    charges, fields : ndarray, shape (n,)
        Charge [e] and field just outside [V/nm] of each atom before it evaporated.
    perturbations : tuple
        Perturbations flown in the run; a user-defined one is its description if the run was loaded from a file.
    flown : tuple of Flown
        Results of each of these perturbations.
    responses : Responses or None
        Response polynomials of every ion.
    seed : int
        Seed of the random numbers of the perturbations.
    voltage : float
        Applied voltage [V].
    detector : Detector
        The detector.
    response_settings : ResponseSettings
        Settings of the responses.
    elements : tuple of str
        Names of the species.
    settings : dict
        All settings of the run, in plain types.
    history : History
        Results of the checks during the run.
    state : EmitterState or None
        State of the emitter at the last relaxation of the run, from which the run can be resumed.
    first_event : int
        Number of atoms that evaporated before the first ion of the run.
    ended : str
        Reason if the run ended early; otherwise "".
    provenance : dict
        Version, time, and under "systems" the processors and libraries of the computation.
    detached : ndarray of bool, shape (n,), optional
        Atoms that left because they had lost all chains of bonds to the body; by default none.
    phase : ndarray of int8, shape (n,), optional
        Index of the phase of each atom into `phase_names`; by default 0.
    cap : CapHistory
        The cap of the surface after each relaxation, at the simulated voltage.
    clock : Clock or None
        Time and voltage of each event, for a law with a temperature.
    units : RealUnits or None
        Operating point of a run in real units, see `at_evaporation_field`.
    real : RealColumns or None
        Its voltages, charges, masses and pulses.

    Examples
    --------
    >>> run = ae.Simulation(ae.Tip("Ni", apex_radius=2.0, axis=(1, 1, 1)), seed=1).run(100)
    >>> run.hits(ae.RollUp(0.2))  # any perturbation, without new flights
    <Hits: 100 ions, 99 detected from 'simulation, RollUp(0.2)'; x, y, time_of_flight, ...>
    >>> real = run.at_evaporation_field()
    >>> print(f"{real.voltages[0]:.0f} V")
    81 V
    """

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
    units: RealUnits | None = None
    real: RealColumns | None = None

    def __post_init__(self):
        if self.detached is None:
            object.__setattr__(self, "detached", np.zeros(len(self.site), bool))
        if self.phase is None:
            object.__setattr__(self, "phase", np.zeros(len(self.site), np.int8))

    def __len__(self) -> int:
        return len(self.site)

    def __getitem__(self, rows: Any) -> "Run":
        """Part of the run: only the selected ions, as if the others had not been recorded.

        Parameters
        ----------
        rows : slice or array_like
            A slice, a mask or indices. The rows stay in the sequence of evaporation, each at most once.

        Returns
        -------
        Run
            With the history of the whole run. Voltages in real units stay those of the whole run if it has them;
            `at_evaporation_field` of the part averages over the selected ions only. `pulses` and `multiplicity` of hits
            count the selected ions.

        Raises
        ------
        ValueError
            If `rows` is of another kind, or in another order.
        IndexError
            If a row does not exist, or a mask has another length than the run.
        """
        if not isinstance(rows, slice):
            indices = np.asarray(rows)
            if indices.ndim != 1 or (indices.size and indices.dtype.kind not in "biu"):
                raise ValueError(f"rows must be a slice, a mask or indices such as [5], got {short_text(rows)}")
            rows = indices if indices.size else np.empty(0, int)
        check_sequence_of_ions(self.emissions.ions[rows], "rows")
        arrays = {path: values[rows] for path, values in columns_of(self, self.every_column).items()}
        return replace(self, **parts_of(arrays, self.emissions.nearest_neighbour_distance))

    @property
    def every_column(self) -> list[Column]:
        """The columns of this run, see `apt_evap.simulation.columns`."""
        columns = [*ALWAYS, *OPTIONAL, *target_columns(self.response_settings)]
        columns += [each for k in range(len(self.flown)) for each in flown_columns(k)]
        if self.responses is not None:
            columns += response_columns(self.response_settings)
        there = columns_of(self, columns)
        return [column for column in columns if column.path in there]

    _repr_html_ = as_table

    def __repr__(self) -> str:
        flown = ", ".join(_describe(perturbation) for perturbation in self.perturbations)
        responses = "" if self.responses is None else f"responses, {self.flagged.sum():,} of them flagged"
        if self.field_of_view is not None and self.responses is not None:
            responses += f"; {self.not_flown.sum():,} ions not flown"
        details = "; ".join(part for part in (responses, flown and f"flown: {flown}", self.ended) if part)
        where = f"{self.voltage:g} V"
        if self.units is not None and len(self):
            where = (
                f"{_range(self.voltages)} V, {self.units.operating_field:.3g} V/nm at the {self.units.field_reference}"
            )
        return f"<Run: {len(self):,} ions of {', '.join(self.elements)} at {where}; {details}>"

    @property
    def phase_names(self) -> tuple[str, ...]:
        """Names of the phases of the specimen; ("matrix",) if there is only one."""
        return tuple(phase["name"] for phase in self.settings["tip"].get("phases", ())) or ("matrix",)

    @property
    def evaporation_fields(self) -> Floats:
        """Evaporation field of the species of each ion [V/nm], shape (n,)."""
        tip = self.settings["tip"]
        # in the order of the species; two of them may have the same name
        materials = tip.get("elements") or [tip["material"], *(each for each, _ in tip["solutes"])]
        return np.array([material["evaporation_field"] for material in materials])[self.species]

    @property
    def voltages(self) -> Floats:
        """Voltage at each event [V], shape (n,): constant, that of the control, or in real units that of the model.

        With voltage pulses it is the voltage at the top of the pulse.
        """
        if self.real is not None:
            return self.real.voltages
        return np.full(len(self), self.voltage) if self.clock is None else self.clock.voltages

    @property
    def instrument_voltages(self) -> Floats:
        """Voltage between specimen and electrode at each event [V], shape (n,), at the top of the pulse."""
        return self.voltages if self.real is None else self.real.instrument_voltages

    @cached_property
    def lens(self) -> RunLens | None:
        """The lens in front of the specimen; None for a specimen in free space."""
        plain = self.settings.get("microscope")
        return None if plain is None else from_plain(plain, RunLens, what="microscope")

    @property
    def flight_charges(self) -> Integers:
        """Charge of each ion in flight [e], shape (n,); without real units that at the barrier."""
        return self.emissions.charge_states if self.real is None else self.real.charges

    @property
    def energy_scales(self) -> Floats:
        """Simulated energy per energy of this run, n V of the simulation over n V in flight, shape (n,).

        1 without real units: energies are those at the simulated voltage and the charge at the barrier.
        """
        if self.real is None:
            return np.ones(len(self))
        return self.emissions.charge_states * self.voltage / (self.real.charges * self.real.voltages)

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

    def fingerprint(self) -> str:
        """Hash of all results, to compare runs.

        Returns
        -------
        str
            SHA-256 over the names, types and values of the columns: emissions, sites, species, charges, fields, times
            and voltages of a control, flown perturbations and responses, but not the real units, which follow from
            them. By design it does not depend on the machine.
        """
        columns = columns_of(self, (column for column in self.every_column if column.hashed))
        hashed = hashlib.sha256()
        for name in sorted(columns):
            values = np.array(columns[name], order="C")
            if values.dtype.kind == "f":
                values[np.isnan(values)] = np.nan  # NaN has many bits, which depend on the processor
            values = values.astype(values.dtype.newbyteorder("<"), copy=False)
            hashed.update(f"{name} {values.dtype.str} {values.shape}\n".encode())
            hashed.update(values.data)
        return hashed.hexdigest()

    def hits(self, perturbation: Perturbation, *, by_response: bool = False) -> Hits:
        """Hits of the ions for a perturbation.

        For a perturbation that was flown in the run, the results of these flights are used. Any other perturbation that
        launches along the surface (all built-in ones, with any energies) is evaluated from the responses. Each ion has
        the same random numbers for every perturbation.

        Parameters
        ----------
        perturbation : perturbation
            Initial conditions of the ions.
        by_response : bool
            Whether to use the responses even for a perturbation that was flown, for comparison.

        Returns
        -------
        Hits
            One row per ion, in the sequence of evaporation; `outcome` is the outcome of each flight. ``extra`` contains
            the element of each ion, its charge and field before evaporation, and the name of its phase if there are
            several.

        Raises
        ------
        ValueError
            If the perturbation was not flown and cannot be evaluated from the responses.
        """
        check_switch(by_response, "by_response")
        directions, times, not_flown = self._landed(perturbation, by_response)
        return self._hits(directions, times, not_flown, perturbation)

    def places(self, perturbation: Perturbation) -> tuple[Floats, Floats, NDArray[np.int8]]:
        """Positions of the hits alone, the same as those of `hits`.

        Parameters
        ----------
        perturbation : perturbation
            As for `hits`.

        Returns
        -------
        x, y : ndarray, shape (n,)
            Detector coordinates [mm].
        outcome : ndarray of int8, shape (n,)
            `Outcome` of each ion.

        Raises
        ------
        ValueError
            As for `hits`.
        """
        x, y, _, outcome = self._impacts(*self._landed(perturbation, False))
        return x, y, outcome

    @cached_property
    def _random(self):
        """Random numbers of the ions, the same for every perturbation."""
        return IonRandom(self.seed, self.emissions.ions)

    def _landed(self, perturbation, by_response):
        """Stereographic directions (n, 2), times of flight (n,) and ions that were not flown, for a perturbation."""
        warn_if_not_for(dict(self.settings.get("rule") or {}).get("name"), perturbation)
        for flown_as, flown in zip(self.perturbations, self.flown, strict=True):
            known = flown_as == perturbation or flown_as == described(perturbation)  # by name and repr in a file
            # the energies of flights were those at the simulated voltage
            if known and not by_response and (self.real is None or perturbation == Unperturbed()):
                return flown.directions, flown.times, None
        if not callable(getattr(perturbation, "tangential", None)):
            check_kind(perturbation, "perturbation", "launch", "a perturbation such as Unperturbed() or RollUp(0.2)")
            raise ValueError(
                f"perturbation {short_text(perturbation)} was not flown in this run and has no method `tangential`; "
                "pass it to the simulation: simulation.run(n, emissions=[...])"
            )
        if self.responses is None:
            raise ValueError(f"this run has no responses and {short_text(perturbation)} was not flown in it")
        emissions = self.emissions
        launches = TangentialLaunches(*perturbation.tangential(emissions, self._random.from_start()))  # type: ignore[attr-defined]
        scale = 1.0
        if self.real is not None and len(self):
            scales = self.energy_scales
            scale, factors = float(np.median(scales)), np.sqrt(scales)
            launches = launches._replace(first=launches.first * factors, second=launches.second * factors)
        directions, times = self.response_model.evaluate(self.responses, launches, emissions.masses, scale)
        return directions, times, self.responses.not_flown

    def _impacts(self, directions, times, not_flown):
        """Positions, times and outcomes on the detector, of flights that end within the field of view."""
        if self.field_of_view is None:
            return self.detector.impacts(*self._seen(directions, times))
        outside = squared_lengths(directions) > stereographic_rim(self.field_of_view) ** 2
        if not_flown is not None:
            outside |= not_flown
        directions, times = np.where(outside[:, None], np.nan, directions), np.where(outside, np.nan, times)
        *columns, outcome = self.detector.impacts(*self._seen(directions, times))
        outcome[outside] = Outcome.OUTSIDE
        return *columns, outcome

    @cached_property
    def _rim(self):
        """Least length of the stereographic directions in which ions at the rim of the field of view arrive."""
        if self.field_of_view is None or not len(self):
            return math.inf
        some = self[np.unique(np.linspace(0, len(self) - 1, _RIM_SAMPLES).astype(int))]
        rim = np.tile([stereographic_rim(self.field_of_view), 0.0], (len(some), 1))
        return float(np.sqrt(squared_lengths(some._seen(rim, np.ones(len(some)))[0])).min())

    def grid(self, bins: int) -> DetectorMap:
        """Empty map of the complete detector, for the `like` of maps of this run.

        Parameters
        ----------
        bins : int
            Number of bins along each side.

        Returns
        -------
        DetectorMap
            Without hits. Bins outside the field of view of the flights are outside its mask.
        """
        grid = self.detector.grid(bins)
        if self._rim >= stereographic_rim(self.detector.half_angle):
            return grid
        x, y = ((edges[1:] + edges[:-1]) / 2 for edges in (grid.x_edges, grid.y_edges))
        places = np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)
        angles = self.detector.seen_from_apex.angles(places).reshape(grid.values.shape)
        mask = np.tan(angles / 2) <= self._rim
        return DetectorMap.from_array(grid.values, grid.x_edges, grid.y_edges, mask, is_counts=True)

    def _rim_on(self, instrument):
        """Least distance from the centre of an instrument at which ions at the rim arrive [mm]."""
        azimuths = 2 * np.pi * np.arange(_RIM_SAMPLES) / _RIM_SAMPLES
        radius = 2 * self._rim / (1 - self._rim**2) * instrument.distance
        places = instrument.places(radius * np.column_stack([np.cos(azimuths), np.sin(azimuths)]))
        return np.nanmin(np.hypot(*places.T), initial=math.inf) * (1 + 1e-6)

    def _warn_if_beyond(self, seen, what):
        """Warn if there are directions within those of a device that are outside the field of view of the flights."""
        if seen:
            warn(
                f"the {what} sees ions outside the field of view of the flights ({self.field_of_view:.4g} degrees), "
                "which are missing: run with a larger field_of_view (FlightSettings, or [flights] in a settings file)",
                RunWarning,
            )

    def _seen(self, directions, times):
        """Directions and times in the instrument, of those of the simulated flights."""
        ions, masses, model, voltages = self.emissions.ions, self.emissions.masses, self.voltages, self.voltages
        if self.real is None:
            # of the flights, also if a control had another one for the events
            model = voltages = np.full(len(self), self.voltage)
        else:
            # t is proportional to sqrt(m / (n V)) on the same path
            masses, voltages = self.real.masses, self.real.instrument_voltages
            times = times * np.sqrt(self.energy_scales * (masses / self.emissions.masses))
        if self.lens is None:
            return directions, times * np.sqrt(model / voltages)
        charges, distance = self.flight_charges, self.detector.distance
        return self.lens.seen(directions, times, ions, masses, charges, model, voltages, distance)

    def _hits(self, directions, times, not_flown, perturbation):
        emissions, columns, units = self.emissions, {}, {"charge": "e", "field": "V/nm"}
        x, y, times, outcome = self._impacts(directions, times, not_flown)
        if self.real is None:
            # of the flights, also if a control had another one for the events
            columns = {"voltage": np.full(len(self), self.voltage)}
            columns["mass_to_charge"] = emissions.masses / emissions.charge_states
            extra = {"charge": self.charges, "field": self.fields}
        else:
            columns = self._measured(times, outcome)
            times = columns.pop("time_of_flight")
            scale = self.real.voltages / self.voltage
            extra = {"charge": self.charges * scale, "field": self.fields * scale, "charge_state": self.real.charges}
            units["charge_state"] = "e"
        extra["element"] = np.array(self.elements)[self.species]
        if len(self.phase_names) > 1:
            extra["phase_name"] = np.array(self.phase_names)[self.phase]
        return Hits(
            x=x,
            y=y,
            time_of_flight=times,
            **columns,
            positions=emissions.positions,
            site=self.site,
            ion=emissions.ions,
            outcome=outcome,
            extra=extra,
            units=units,
            source=f"simulation, {_describe(perturbation)}",
            extent=self.detector.extent if self._rim >= stereographic_rim(self.detector.half_angle) else None,
        )

    def _measured(self, times, outcome):
        """Columns that an instrument would record: voltages, pulses, times with their errors, m/n from these."""
        units, real = self.units, self.real
        total = real.instrument_voltages
        fraction = units.control.pulse_fraction
        columns = {"voltage": total / (1.0 + fraction), "pulse_id": real.pulse_ids}
        if fraction > 0:
            columns["pulse_voltage"] = total - columns["voltage"]
        columns["mass_to_charge"] = real.masses / real.charges
        if units.timing is not None:
            # an instrument is calibrated for its paths, so that m/n is the true one for an exact time
            deficits, delays = units.timing.errors(random_of(units.seed, self.emissions.ions)[:, 3:])
            with np.errstate(invalid="ignore"):
                late = (times / np.sqrt(1.0 - deficits) + delays) / times
            columns["mass_to_charge"] = columns["mass_to_charge"] * late * late
            times = times * late
        columns["time_of_flight"] = times
        hit = np.flatnonzero(outcome == Outcome.HIT)
        pulses, multiplicity = np.zeros(len(self), np.uint32), np.zeros(len(self), np.uint32)
        if len(hit):
            pulse = real.pulse_ids[hit]
            pulses[hit] = np.diff(pulse, prepend=pulse[0])
            first, counts = np.unique(pulse, return_counts=True)
            multiplicity[hit] = counts[np.searchsorted(first, pulse)]
        return columns | {"pulses": pulses, "multiplicity": multiplicity}

    def at_evaporation_field(
        self, lens: LocalElectrode | None = None, point: OperatingPoint | None = None, **arguments: Any
    ) -> "Run":
        r"""The same run in real units: at the voltages that bring it to its evaporation field.

        Energies of perturbations are then true eV, `voltages` true V and times of flight true ns. Nothing is simulated
        again.

        Parameters
        ----------
        lens : LocalElectrode, optional
            Lens of specimen, shank and electrode. Voltages, positions of hits and times of flight are then those of the
            instrument, as its voltage and its image compression follow the radius of the cap; see `on_detector`.
        point : OperatingPoint, optional
            Operating field, charges in flight, pulses and errors of the times; by default `OperatingPoint()`.
        **arguments
            Fields of `OperatingPoint` that replace those of `point`: ``run.at_evaporation_field(field_factor=3.3)``.

        Returns
        -------
        Run
            With voltages, charges, isotopes and pulses of each ion in `real`, and the operating point in `units`.

        Raises
        ------
        ValueError
            If an argument is outside its range, the run does not contain the fields of its cap, or a lens is given for
            a specimen that is not a cap on a shank.

        Notes
        -----
        All fields are proportional to the voltage. With the field :math:`F_i` at the simulated voltage :math:`V`, the
        ion i has the voltage

        .. math:: V_i = V \, \frac{x \, F_\mathrm{evap}}{F_i}

        with the operating field :math:`x F_\mathrm{evap}`, averaged over the last ions. Evaporation fields are those of
        the species, also for a law with bonds. The path depends on
        :math:`E_\perp / (n V)` only, and the time of flight is proportional to :math:`\sqrt{m / (n V)}`.
        """
        if point is not None:
            check_kind(point, "point", OperatingPoint, "an OperatingPoint")
        run = self._behind(lens)
        units, real = in_real_units(run, changed(point or OperatingPoint(), arguments))
        return replace(run, units=units, real=real)

    def _behind(self, lens):
        """The same run with a lens; without one, itself."""
        if lens is None:
            return self
        check_kind(lens, "lens", LocalElectrode, "a LocalElectrode")
        history = RadiusHistory(self.cap.ions, self.cap.radii, self.cap.apexes)
        imaged = RunLens.of(lens, self.settings["tip"], history, self.emissions.nearest_neighbour_distance)
        return replace(self, settings=self.settings | {"microscope": to_plain(imaged)})

    def simulated(self) -> "Run":
        """The same run without real units, at the simulated voltage."""
        return self if self.units is None else replace(self, units=None, real=None)

    def on_detector(self, detector: Detector, lens: LocalElectrode | None = None) -> "Run":
        """The same ions on another detector.

        Parameters
        ----------
        detector : Detector
            Detector with another distance, width or projection. Outside the field, the time of flight is proportional
            to the distance.
        lens : LocalElectrode, optional
            Lens in front of the specimen; by default that of the run, if it has one. The angle of the simulated flight
            is traced back to the cap by the free specimen, and from there to the detector by the lens. Ions that the
            electrode stops miss the detector.

        Returns
        -------
        Run

        Raises
        ------
        ValueError
            If the specimen is not a cap on a shank, or the lens has a potential of the detector and the run is not in
            real units, so that its voltages are not known.
        """
        check_kind(detector, "detector", Detector, "a Detector")
        if lens is not None:
            behind = self._behind(lens)
            if self.real is not None and (self.lens is None or self.lens.lens != lens):
                raise ValueError(
                    f"lens changes the voltages of a run in real units: use run.at_evaporation_field(lens), got {lens}"
                )
            if self.real is None and lens.detector_potential:
                raise ValueError(
                    f"lens has the detector_potential {lens.detector_potential:g} V, whose influence depends on the "
                    "voltages: use run.at_evaporation_field(lens)"
                )
            run = behind._shown_on(detector)
        else:
            run = self._shown_on(detector)
        edge = stereographic_rim(detector.polar_angle(detector.width / 2))
        run._warn_if_beyond(run._rim < edge * (1 - 1e-6), "detector")
        return run

    def _shown_on(self, detector):
        """The same run on another detector."""
        ratio = detector.distance / self.detector.distance
        flown, responses = self.flown, self.responses
        if ratio != 1.0:
            flown = tuple(Flown(each.directions, each.times * ratio) for each in flown)
            if responses is not None:
                factors = np.array([1.0, 1.0, ratio], np.float32)[:, None]  # directions and time
                site, rolled = responses.site * factors, responses.rolled * factors
                responses = replace(responses, site=site, rolled=rolled, residuals=responses.residuals * ratio)
        settings = self.settings | {"detector": to_plain(detector)}
        return replace(self, detector=detector, settings=settings, flown=flown, responses=responses)

    def record(
        self, instrument: Instrument, perturbation: Perturbation | None = None, *, seed: int | None = None
    ) -> Hits:
        """Ions that an instrument records.

        Parameters
        ----------
        instrument : Instrument
            The instrument, which records the ions of a run in real units.
        perturbation : perturbation, optional
            Initial conditions of the ions; by default the first perturbation flown in the run, or `Unperturbed`.
        seed : int, optional
            Seed of the random numbers of the instrument; by default that of the run.

        Returns
        -------
        Hits
            What the instrument writes, and the truth: `site`, `ion`, `positions`, and in `extra` the species, the phase
            if there are several, the charge in flight, and charge and field before evaporation.

        Raises
        ------
        ValueError
            If the run is not in real units.
        """
        check_kind(instrument, "instrument", Instrument, "an Instrument")
        if self.units is None:
            raise ValueError(
                "this run is not in real units, so it has no voltages, times and pulses that an instrument could "
                "record: use run.at_evaporation_field().record(instrument)"
            )
        # errors of the times of an instrument replace those of the run
        units = self.units if instrument.timing is None else replace(self.units, timing=None)
        plane = replace(self, units=units, detector=replace(self.detector, projection="plane"))
        hits = plane.hits(self.first_perturbation if perturbation is None else perturbation)
        self._warn_if_beyond(self._rim < 1.0 and self._rim_on(instrument) < instrument.field_of_view / 2, "instrument")
        truth = {"species": self.species}
        if len(self.phase_names) > 1:
            truth["phase"] = self.phase
        hits = replace(hits, extra=hits.extra | truth)
        return instrument.hits(hits, self.detector.distance, seed=self.seed if seed is None else check_seed(seed))

    def summary(self) -> dict[str, Any]:
        """Counts, dict: ions, outcomes of the first perturbation, ions that cannot roll up, flagged ions.

        With a field of view, also the ions outside it, and those of them that were not flown.
        """
        first = self.first_perturbation
        counts = {outcome.name.lower(): count for outcome, count in self.hits(first).counts.items()}
        if self.field_of_view is None:
            del counts["outside"]
        else:
            counts |= {"not_flown": int(self.not_flown.sum())}
        return {
            "ions": len(self),
            "perturbation": _describe(first),
            **counts,
            "without_neighbour": int((~self.emissions.can_roll).sum()),
            "detached": int(self.detached.sum()),
            "flagged": int(self.flagged.sum()),
            "ended": self.ended,
        }

    # ---- parts -----------------------------------------------------------------------------------------------------

    @classmethod
    def join(cls, runs: "Sequence[Run]") -> "Run":
        """Join the parts of one run.

        Parameters
        ----------
        runs : sequence of Run
            At least one part, in the sequence of evaporation. Ions may be missing between them.

        Returns
        -------
        Run
            With the state and the end of the first part.

        Raises
        ------
        ValueError
            If there is no part, the parts belong to different runs, or their ions do not follow one another.
        """
        runs = check_sequence(runs, "runs", "parts of a run")
        if not runs:
            raise ValueError("runs must be at least one part of a run, got none")
        first = runs[0]
        for number, run in enumerate(runs):
            check_kind(run, f"runs[{number}]", Run, "a Run")
            if name := _difference(first, run):
                raise ValueError(f"runs must be parts of one run, got runs[{number}] whose {name} differ from runs[0]")
        check_sequence_of_ions(np.concatenate([run.emissions.ions for run in runs]), "ions of the joined runs")
        parts = [columns_of(run, run.every_column) for run in runs]
        arrays = {path: np.concatenate([part[path] for part in parts]) for path in parts[0]}
        return replace(
            first,
            **parts_of(arrays, first.emissions.nearest_neighbour_distance),
            history=History.join([run.history for run in runs]),
            cap=CapHistory.join([run.cap for run in runs]),
            provenance=joined([run.provenance for run in runs]),
        )

    def ended_by(self, reason: str) -> "Run":
        """The same run with the reason of an early end."""
        return replace(self, ended=reason)

    # ---- files -----------------------------------------------------------------------------------------------------

    def save(self, path: AnyPath) -> None:
        """Write the run to an HDF5 file. The file is either complete or absent.

        Parameters
        ----------
        path : str or path-like
            The file to write or overwrite.

        Raises
        ------
        FileError
            If it cannot be written.
        """
        write_run(path, self)


def load(path: AnyPath) -> Run:
    """Read a run from an HDF5 file of `Run.save`, or from that of an unfinished run.

    Parameters
    ----------
    path : str or path-like
        The file; or the one beside it, whose name ends in ".unfinished" (see `Checkpoint`).

    Returns
    -------
    Run

    Raises
    ------
    FileError
        If it is missing, unreadable, damaged or not a run.

    Examples
    --------
    >>> run = ae.Simulation(ae.Tip("Ni", apex_radius=2.0, axis=(1, 1, 1)), seed=1).run(100)
    >>> run.save("ni111.h5")
    >>> ae.load("ni111.h5")
    <Run: 100 ions of Ni at 1000 V; responses, 0 of them flagged>
    """
    return Run(**read_run(path))


def _difference(one, other):
    """Name of the first property that differs between two parts of one run; "" if there is none."""
    if one is other:
        return ""
    pairs = {
        "settings": (one.settings, other.settings),
        "elements": (one.elements, other.elements),
        "perturbations": tuple([described(each) for each in run.perturbations] for run in (one, other)),
        "responses": (one.responses is None, other.responses is None),
        "real units": (one.units, other.units),
        "columns": tuple([column.path for column in run.every_column] for run in (one, other)),
    }
    return next((name for name, (first, second) in pairs.items() if first is not second and first != second), "")


def _describe(perturbation):
    return perturbation.get("repr", json.dumps(perturbation)) if isinstance(perturbation, dict) else repr(perturbation)


def _range(values):
    """Smallest and largest number, or the only one."""
    low, high = f"{values.min():.4g}", f"{values.max():.4g}"
    return low if low == high else f"{low} to {high}"
