"""The applied voltage, and its control to a constant rate of evaporation."""

import math
from collections.abc import Callable
from typing import Any, Protocol, runtime_checkable

import numpy as np

from apt_evap._common.codec import count, number, settings
from apt_evap._common.types import Floats
from apt_evap._common.validation import check_kind, check_number
from apt_evap._core.control import SteadyRate
from apt_evap._core.elementary import exponential, logarithm
from apt_evap._core.law import LawKernel
from apt_evap.detection.hits import Hits
from apt_evap.specimen.tip import Tip
from apt_evap.units import BOLTZMANN

_STEP = 1e-6  # relative, for the slope of the rate: 1e-3 of what changes the rate by a factor of e at 20 K
_LARGEST_STEP = 0.05  # relative change of the voltage in one step of Newton's method
_ITERATIONS = 8  # of Newton's method; 1 to 3 suffice but on the first layers of an ideal tip
_CLOSE = 1e-3  # of the logarithm of the rate: far below its changes by single events
_LARGEST_SLOPE = 3.0  # [kT/(C x)]: barriers without a slope at x = 1 have none for an atom that is about to leave there
_BISECTIONS = 60  # from six decades to the rounding of float64


def check_voltage(voltage: Any) -> float:
    """Return the applied voltage [V], > 0 and <= 1 MV; ValueError otherwise."""
    return check_number(voltage, "voltage", above=0, at_most=1e6, unit="V")


@settings
class VoltageControl:
    """Voltage of an instrument: a constant rate of evaporation, with or without voltage pulses.

    Notes
    -----
    The voltage V that the atoms see at the top of a pulse is V_dc + V_p. The control of a law with a temperature raises
    the logarithm of all rates by 1/memory in the mean time between two ions, and lowers it by 1/memory with every ion:
    the mean rate is the wanted one. This changes V by dlnV = dlnK s, with s = dlnV/dlnK of the sum of the rates.

    Examples
    --------
    >>> tip = ae.Tip("Ni", apex_radius=2.0, axis=(1, 1, 1))
    >>> control = ae.evaporation.VoltageControl(rate=0.01, pulse_fraction=0.2)
    >>> run = ae.Simulation(tip, seed=1, control=control).run(100)
    >>> hits = run.at_evaporation_field().hits(ae.Unperturbed())
    >>> print(f"{hits.voltage[0]:.0f} V and pulses of {hits.pulse_voltage[0]:.0f} V")
    67 V and pulses of 13 V
    >>> print(f"{len(hits) / hits.pulses.sum():.2f} ions per pulse")
    0.01 ions per pulse
    """

    rate: float = number(
        "Ions per pulse, of the voltage or of a laser; without pulses, ions per second. 0.002 to 0.05 ions per pulse "
        "are usual.",
        default=0.01,
        above=0,
        at_most=1e6,
    )
    pulse_fraction: float = number(
        "Height of the voltage pulse relative to the standing voltage, V_p / V_dc; 0.2 is usual. 0: no pulses.",
        default=0.2,
        at_least=0,
        at_most=1,
    )
    pulse_width: float = number(
        "Standard deviation of the Gaussian top of a pulse.", default=0.5, above=0, at_most=1e6, unit="ns"
    )
    pulse_frequency: float = number(
        "Pulses per second; only for the duration of a measurement.", default=200.0, above=0, at_most=1e6, unit="kHz"
    )
    memory: int = count(
        "Number of ions over which the control averages the rate.", default=250, at_least=1, at_most=1_000_000
    )

    @classmethod
    def of_hits(cls, hits: Hits, seen: float = 1.0, **changes: Any) -> "VoltageControl":
        """Control of a measurement: its rate, and its pulse fraction.

        Parameters
        ----------
        hits : Hits
            Measured ions with the pulses between them, and with both voltages.
        seen : float
            Fraction of the ions that leave which the instrument detects: its efficiency times the share of the ions in
            its field of view. An instrument controls the rate of the detected ions; `rate` is that of all.
        **changes
            Fields of `VoltageControl` that are not in the file, such as the width of the pulses.

        Returns
        -------
        VoltageControl

        Raises
        ------
        ValueError
            If a column is missing, there are no pulses, or `seen` is not a fraction.

        Examples
        --------
        >>> ions = ae.Hits(voltage=np.full(50, 5000.0), pulse_voltage=np.full(50, 1000.0), pulses=np.full(50, 200))
        >>> control = ae.evaporation.VoltageControl.of_hits(ions, seen=0.5)
        >>> control.rate, control.pulse_fraction
        (0.01, 0.2)
        """
        check_kind(hits, "hits", Hits, "Hits, such as read(path)")
        seen = check_number(seen, "seen", above=0, at_most=1)
        pulses, standing, pulse = hits.require("pulses", "voltage", "pulse_voltage")
        if not (len(hits) and pulses.sum() > 0 and (standing > 0).all()):
            raise ValueError(
                f"hits must have pulses and voltages, got {int(pulses.sum())} pulses and {len(hits)} ions, "
                f"{int(np.count_nonzero(standing <= 0))} of them without a voltage"
            )
        rate = len(hits) / float(pulses.sum()) / seen
        return cls(**{"rate": rate, "pulse_fraction": float(np.median(pulse / standing)), **changes})

    def effective_width(self, softness: float) -> float:
        r"""Time at the top of a pulse with the same number of events [s].

        Parameters
        ----------
        softness : float
            kT / (C x): relative change of the field that changes the rate by a factor of e, at the top of the pulse.

        Returns
        -------
        float

        Notes
        -----
        The field is :math:`F(t) = F_\mathrm{dc} (1 + p \exp(-t^2 / 2 s^2))`, so that to second order the rate is a
        Gaussian, with the integral

        .. math:: \tau = s \sqrt{2 \pi \, \frac{k T}{C x} \, \frac{1 + p}{p}}
        """
        p = self.pulse_fraction
        return 1e-9 * self.pulse_width * math.sqrt(2.0 * math.pi * softness * (1.0 + p) / p)


@runtime_checkable
class ThermalLaw(Protocol):
    """Interface of a law with rates, whose events take time: the voltage is controlled (`RateControl`)."""

    @property
    def peak_temperature(self) -> float:
        """Temperature at which most events happen [K]; 0 for a law without rates."""
        ...

    def default_control(self) -> VoltageControl:
        """Control of the voltage if none is given."""
        ...

    def sensitivities(self, tip: Tip) -> Floats:
        """Sensitivity C of each species [eV], shape (n_species,)."""
        ...

    def working_point(self, sensitivity: float, control: VoltageControl) -> tuple[float, float]:
        """Barrier over kT at the wanted rate, and the time at the top of a pulse [s], 0 without pulses."""
        ...

    def kernel(self, tip: Tip, control: VoltageControl | None = None) -> LawKernel:
        """Return the compiled law for a specimen, whose keys are logarithms of rates."""
        ...


class RateControl(SteadyRate):
    """Control of the voltage of an emitter, for a law with a temperature: see ``_core/control.pxd`` for the interface.

    Parameters
    ----------
    control : VoltageControl
        Wanted rate, and memory.
    pulse_length : float
        Time per pulse with the rate of its top [s]; 0 without pulses.
    softness : float
        kT / (C x) at the working point.
    """

    def __init__(self, control: VoltageControl, pulse_length: float, softness: float) -> None:
        super().__init__(control.rate / (pulse_length or 1.0), control.memory)
        self.control, self.pulse_length = control, pulse_length
        self._largest_slope = _LARGEST_SLOPE * softness
        self._slope = math.nan  # dlnV/dlnK at the last relaxation

    @classmethod
    def of(cls, law: ThermalLaw, tip: Tip, control: VoltageControl | None) -> "RateControl":
        """Return the control for a law on a specimen; by default the usual one of the law."""
        control = law.default_control() if control is None else control
        sensitivity = float(law.sensitivities(tip)[0])
        barrier, pulse_length = law.working_point(sensitivity, control)
        thermal = BOLTZMANN * law.peak_temperature / sensitivity
        return cls(control, pulse_length, thermal / max(1.0 - barrier * thermal, 0.3))

    def voltage_factors(self, rises: Any) -> Any:
        """Voltage over that of the charges, from the logarithm of the factor of the rates since the relaxation."""
        return self.voltage_factor * exponential(self._slope * rises)

    def before_relaxation(self, log_rate: float, log_rate_at: Callable[[float], float]) -> float:
        """Voltage factor with the changes since the last relaxation.

        The first guess of the factor is linear in the logarithm of the rate; it is then corrected.
        """
        goal = log_rate + self.rise
        factor = float(self.voltage_factors(self.rise))
        for _ in range(_ITERATIONS):
            logs = self._logs(log_rate_at, factor)
            if not (math.isfinite(goal) and abs(goal - logs[1]) > _CLOSE):
                break
            step = _STEP / max(logs[0] - logs[1], 1e-12) * (goal - logs[1])
            factor *= float(exponential(min(max(step, -_LARGEST_STEP), _LARGEST_STEP)))
        return factor

    def after_relaxation(self, log_rate_at: Callable[[float], float]) -> float:
        """Determine the slope of the rate; on the first surface, find the voltage of the wanted rate."""
        factor = self._solve(log_rate_at) if math.isnan(self._slope) else self.voltage_factor
        logs = self._logs(log_rate_at, factor)
        self._slope = min(_STEP / max(logs[0] - logs[1], 1e-12), self._largest_slope)
        return factor

    def _logs(self, log_rate_at, factor):
        """Logarithm of the rate at a slightly higher voltage, and at this one."""
        return [log_rate_at(factor * part) for part in (1.0 + _STEP, 1.0)]

    def _solve(self, log_rate_at):
        """Factor of the voltage at which the sum of the rates is the wanted one, by bisection."""
        goal = float(logarithm(self.rate))
        low, high = math.log(1e-3), math.log(1e3)
        for _ in range(_BISECTIONS):
            middle = 0.5 * (low + high)
            if log_rate_at(float(exponential(middle))) < goal:
                low = middle
            else:
                high = middle
        if abs(log_rate_at(float(exponential(middle))) - goal) > 0.1:
            raise ValueError(
                f"no voltage gives the rate of {self.control.rate:g} of the control: at this temperature atoms leave "
                "faster or slower at any field; choose another rate, temperature or barrier"
            )
        return float(exponential(middle))
