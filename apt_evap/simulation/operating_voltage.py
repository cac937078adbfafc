"""The voltages at which the ions of a run fly: those of the simulation, or those of real units.

Both classes have the same attributes, so that whoever needs voltages, charges or energies does not ask which they are.
"""

from functools import cached_property
from typing import Any, NamedTuple

import numpy as np

from apt_evap._common.codec import from_plain
from apt_evap._common.types import Floats, Integers
from apt_evap.detection.hits import Outcome
from apt_evap.detection.microscope.local_electrode import LocalElectrode
from apt_evap.evaporation.voltage import VoltageControl
from apt_evap.simulation.columns import Clock
from apt_evap.simulation.real_units import RealColumns, RealUnits, random_of
from apt_evap.simulation.run_table import RunTable


class IonRates(NamedTuple):
    """Number of ions per pulse or second, in sections of a run."""

    values: Floats
    """Ions per unit of time in each section."""
    per: str
    """The unit of time: "pulse" or "second"."""
    goal: float | None
    """Rate that the control of the voltage aims at, if there is one."""


def rates_of_clock(run: RunTable, clock: Clock, edges: Integers) -> IonRates:
    """Rates of a run by its clock between these rows; the last edge is the end of the run."""
    pulse_length = run.settings.get("pulse_length")
    time = np.add.reduceat(clock.waits, edges[:-1]) / (pulse_length or 1.0)
    goal = (run.settings.get("control") or {}).get("rate")
    return IonRates(np.diff(edges) / time, "pulse" if pulse_length else "second", goal)


class SimulatedVoltage:
    """The simulated voltage: energies are those at it, charges those at the barrier, masses those of the run.

    Parameters
    ----------
    run : RunTable
        The table of the run.
    """

    energies_as_flown = True
    """Whether energies are those of the flights of the simulation."""
    field_reference: str | None = None
    """Reference of the operating field, see `OperatingPoint`; None if there is no operating field."""

    cap_field: float | None = None
    """Mean field of the cap to which the voltage leads [V/nm], if there is one."""

    def __init__(self, run: RunTable) -> None:
        self.run = run
        self.flight_voltages = np.full(len(run), run.voltage)
        """Voltage of the free specimen in the flights [V], shape (n,), also if a control had another for the events."""
        self.voltages: Floats = self.flight_voltages if run.clock is None else run.clock.voltages
        """Voltage at each event [V], shape (n,)."""

    @property
    def is_constant(self) -> bool:
        """Whether all events have the same voltage."""
        return self.voltages is self.flight_voltages

    @property
    def control(self) -> VoltageControl:
        """Rate, pulses and control of the voltage; the usual ones if the run has none."""
        return from_plain(self.run.settings.get("control") or {}, VoltageControl)

    @property
    def instrument_voltages(self) -> Floats:
        """Voltage between specimen and electrode at each event [V], shape (n,)."""
        return self.voltages

    @property
    def instrument_flight_voltages(self) -> Floats:
        """The same of the flights [V], shape (n,)."""
        return self.flight_voltages

    @property
    def charges(self) -> Integers:
        """Charge of each ion in flight [e], shape (n,)."""
        return self.run.emissions.charge_states

    @property
    def masses(self) -> Floats:
        """Mass of each ion in flight [Da], shape (n,)."""
        return self.run.emissions.masses

    @property
    def energy_scales(self) -> Floats:
        """Simulated energy per energy in flight, shape (n,)."""
        return np.ones(len(self.run))

    def check_lens(self, lens: LocalElectrode, before: LocalElectrode | None) -> None:
        """Raise ValueError if the influence of a lens depends on voltages that are not known."""
        if lens.detector_potential:
            raise ValueError(
                f"lens has the detector_potential {lens.detector_potential:g} V, whose influence depends on the "
                "voltages: use run.at_evaporation_field(lens)"
            )

    def require_units(self, what: str) -> RealUnits:
        """Operating point of the run; ValueError for a run that is not in real units."""
        raise ValueError(
            f"{what} needs a run in real units: use run.at_evaporation_field(), or --real-units, got {self.run!r}"
        )

    def ion_rates(self, edges: Integers) -> IonRates | None:
        """Rates of the ions between these rows, by the clock of the run; None without one."""
        return None if self.run.clock is None else rates_of_clock(self.run, self.run.clock, edges)

    def columns(self, times: Floats, outcome: Integers) -> dict[str, Any]:
        """Columns of `Hits` that depend on the voltage.

        Parameters
        ----------
        times : ndarray, shape (n,)
            Times of flight [ns].
        outcome : ndarray of int8, shape (n,)
            `Outcome` of each ion.

        Returns
        -------
        dict
        """
        return {"voltage": self.flight_voltages, "mass_to_charge": self.masses / self.charges, "time_of_flight": times}

    def truth(self) -> dict[str, Any]:
        """Charge [e] and field [V/nm] of each atom before it evaporated, for `Hits.extra`."""
        return {"charge": self.run.charges, "field": self.run.fields}


class RealVoltage:
    """The voltages of a run in real units, see `Run.at_evaporation_field`: energies are true eV.

    Parameters
    ----------
    run : RunTable
        The table of the run.
    units : RealUnits
        Its operating point.
    real : RealColumns
        Its voltages, charges, masses and pulses.
    """

    energies_as_flown = False
    is_constant = False

    def __init__(self, run: RunTable, units: RealUnits, real: RealColumns) -> None:
        self.run, self.units, self.real = run, units, real
        self.control, self.field_reference = units.control, units.field_reference
        self.cap_field = units.operating_field if self.field_reference == "cap" else None
        self.voltages = self.flight_voltages = real.voltages
        self.instrument_voltages = self.instrument_flight_voltages = real.instrument_voltages
        self.charges, self.masses = real.charges, real.masses

    @cached_property
    def energy_scales(self) -> Floats:
        """Simulated energy per energy in flight, n V of the simulation over n V in flight, shape (n,)."""
        return self.run.emissions.charge_states * self.run.voltage / (self.charges * self.voltages)

    def check_lens(self, lens: LocalElectrode, before: LocalElectrode | None) -> None:
        """Raise ValueError if a lens changes the voltages."""
        if lens != before:
            raise ValueError(
                f"lens changes the voltages of a run in real units: use run.at_evaporation_field(lens), got {lens}"
            )

    def require_units(self, what: str) -> RealUnits:
        """Operating point of the run."""
        return self.units

    def ion_rates(self, edges: Integers) -> IonRates | None:
        """Rates of the ions between these rows: by the clock, or by the pulses; None without both."""
        if self.run.clock is not None:
            return rates_of_clock(self.run, self.run.clock, edges)
        if self.control.pulse_fraction == 0:
            return None
        pulses = np.diff(self.real.pulse_ids[edges[1:] - 1], prepend=0)
        return IonRates(np.diff(edges) / np.maximum(pulses, 1), "pulse", self.control.rate)

    def columns(self, times: Floats, outcome: Integers) -> dict[str, Any]:
        """Columns of `Hits` that an instrument would record: voltages, pulses, times with their errors, m/n of these.

        Parameters and result are those of `SimulatedVoltage.columns`.
        """
        total, pulse_ids = self.instrument_voltages, self.real.pulse_ids
        fraction = self.units.control.pulse_fraction
        columns = {"voltage": total / (1.0 + fraction), "pulse_id": pulse_ids}
        if fraction > 0:
            columns["pulse_voltage"] = total - columns["voltage"]
        columns["mass_to_charge"] = self.masses / self.charges
        if self.units.timing is not None:
            # an instrument is calibrated for its paths, so that m/n is the true one for an exact time
            uniform = random_of(self.units.seed, self.run.emissions.ions)[:, 3:]
            deficits, delays = self.units.timing.errors(uniform)
            with np.errstate(invalid="ignore"):
                late = (times / np.sqrt(1.0 - deficits) + delays) / times
            columns["mass_to_charge"] = columns["mass_to_charge"] * late * late
            times = times * late
        columns["time_of_flight"] = times
        hit = np.flatnonzero(outcome == Outcome.HIT)
        pulses, multiplicity = np.zeros(len(times), np.uint32), np.zeros(len(times), np.uint32)
        if len(hit):
            pulse = pulse_ids[hit]
            pulses[hit] = np.diff(pulse, prepend=pulse[0])
            first, counts = np.unique(pulse, return_counts=True)
            multiplicity[hit] = counts[np.searchsorted(first, pulse)]
        return columns | {"pulses": pulses, "multiplicity": multiplicity}

    def truth(self) -> dict[str, Any]:
        """Charge [e] and field [V/nm] of each atom before it evaporated, and charge in flight [e]."""
        scale = self.voltages / self.run.voltage
        return {
            "charge": self.run.charges * scale,
            "field": self.run.fields * scale,
            "charge_state": self.charges,
        }
