"""Thermally activated evaporation: rates of all atoms, at a temperature, under a laser, with controlled voltage."""

from collections.abc import Mapping
from typing import Any

import numpy as np

from apt_evap._common.codec import checked, choice, number, part, settings, vector
from apt_evap._common.small_matrices import lengths
from apt_evap._common.types import Floats
from apt_evap._common.validation import check_number, short_text
from apt_evap._core.elementary import logarithm
from apt_evap._core.law import BARRIERS, LawKernel, ThermalRate, WeightedField
from apt_evap.detection.timing import Cooling
from apt_evap.evaporation.bonds import BondField, bond_table, bonds_field
from apt_evap.evaporation.law import Extremal
from apt_evap.evaporation.voltage import VoltageControl
from apt_evap.specimen.tip import Tip
from apt_evap.units import BOLTZMANN

CANDIDATES = 100.0  # atoms that may leave next; measured on Ni[111], R = 16 a: 45 at 50 K, 222 at 300 K, more with R
_ROUNDS = 20  # of the fixed point of width of a pulse and barrier; it converges to 1e-12


def _not_zero(direction, name):
    if not lengths(np.array(direction)) > 0:
        raise ValueError(f"{name} must not be zero, got {short_text(direction)}")
    return direction


@settings
class Laser:
    """Laser pulses that heat the specimen, one side more than the other.

    Notes
    -----
    At the peak T = T_0 + dT (1 + a n.s)/(1 + a), with the direction s of the light and the outward normal n of the
    smooth cap, whose component across the axis is (x, y)/R at the site, with the initial radius R. After the peak T
    decays exponentially.
    """

    temperature_rise: float = number(
        "Rise of the temperature at the peak on the hottest side.", above=0, at_most=5000, unit="K"
    )
    decay: float = number("Time constant of the cooling.", default=1.0, above=0, at_most=1e6, unit="ns")
    direction: tuple[float, float] = vector(
        "Direction from which the light comes, perpendicular to the axis: x and y of any length.",
        2,
        default=(1.0, 0.0),
        check=_not_zero,
    )
    asymmetry: float = number(
        "a, from 0 (both sides equally hot) to 1 (no rise on the far side).", default=0.0, at_least=0, at_most=1
    )

    def temperatures(self, positions: Floats, radius: float, base: float) -> Floats:
        """Temperature of each atom at the peak of a pulse [K], shape (n,).

        Parameters
        ----------
        positions : ndarray, shape (n, 3)
            Atoms [nm].
        radius : float
            Radius of the apex [nm].
        base : float
            Temperature before the pulse [K].
        """
        direction = np.array(self.direction) / lengths(self.direction)
        side = positions[:, 0] * (direction[0] / radius) + positions[:, 1] * (direction[1] / radius)
        rise = (1.0 + self.asymmetry * np.clip(side, -1.0, 1.0)) / (1.0 + self.asymmetry)
        return base + self.temperature_rise * rise


def _sensitivity(sensitivity, name):
    """One sensitivity, or sensitivities by element."""
    if isinstance(sensitivity, Mapping):
        return {
            key: check_number(value, f"{name} of {key}", above=0, at_most=1000, unit="eV")
            for key, value in sensitivity.items()
        }
    return check_number(sensitivity, name, above=0, at_most=1000, unit="eV")


@settings
class Arrhenius:
    """Thermal law: every atom leaves at the rate nu_0 exp(-Q(F)/kT); an event is drawn from all rates.

    Notes
    -----
    ============  =========================  ===============================================================
    barrier       Q(x)                       constant, for a slope of -C at the working point
    ============  =========================  ===============================================================
    linear        C (1 - x)
    image_hump    Q_0 (1 - sqrt(x))          Q_0 = 2 C; the slope at x = 1
    parabolic     W (1/x - 1)^2              W = C^2/(4 Q_op), charge hopping (Forbes)
    quadratic     W (1 - x)^2                W = C^2/(4 Q_op)
    ============  =========================  ===============================================================

    At the working point Q_op = kT ln(nu_0 t N / n) for n ions in the time t from about N = 100 atoms that may leave
    next. The slope of the last two is -C to first order in Q_op/C. The order depends on dlnk/dlnF there, which is (C -
    Q_op)/kT for the linear form, and (C - Q_op/2)/kT, (C + 2 Q_op)/kT and (C - 2 Q_op)/kT for the others. The linear
    form was measured as tails of mass peaks (Field evaporation energy loss spectroscopy, Communications Physics 6,
    2023).

    The sequence is drawn by the residence-time algorithm: the next atom i has the probability k_i / sum(k), and its
    time is exponential with the rate sum(k), which `VoltageControl` steers. Random numbers depend on the seed and the
    number of the event only.

    Examples
    --------
    >>> tip = ae.Tip("Ni", apex_radius=2.0, axis=(1, 1, 1))
    >>> for temperature in (50.0, 300.0):
    ...     run = ae.Simulation(tip, seed=1, law=ae.Arrhenius(temperature)).run(50)
    ...     print(f"{temperature} K: {np.median(run.clock.voltages):.0f} V")
    50.0 K: 56 V
    300.0 K: 34 V
    """

    temperature: float = number(
        "Temperature of the specimen, before laser pulses. 0 is the extremal law, bit by bit.",
        at_least=0,
        at_most=5000,
        unit="K",
    )
    sensitivity: float | Mapping[str, float] = checked(
        "C = -dQ/dx at the working point, x = F/F_evap, for all atoms or by element. About 1 eV for most metals.",
        "float or mapping",
        _sensitivity,
        default=1.0,
        unit="eV",
        hash=False,
    )
    attempt_frequency: float = number("nu_0, 1e12 to 1e13.", default=1e13, above=0, at_most=1e20, unit="1/s")
    barrier: str = choice("Form of the barrier, see the notes.", BARRIERS, default="linear")
    laser: Laser | None = part("Laser pulses.", Laser, default=None)
    bonds: BondField | None = bonds_field()

    def _check(self):
        if self.laser is not None:
            check_number(self.temperature, "temperature", above=0, unit="K", why="the far side stays at it")

    @property
    def peak_temperature(self) -> float:
        """Temperature at which most events happen [K]: that of the hottest side at the peak of a laser pulse."""
        return self.temperature + (0.0 if self.laser is None else self.laser.temperature_rise)

    def sensitivities(self, tip: Tip) -> Floats:
        """Sensitivity C of each species [eV], shape (n_species,).

        Raises
        ------
        ValueError
            If a species has none, or one is of an unknown element.
        """
        names = [element.name for element in tip.elements]
        if not isinstance(self.sensitivity, Mapping):
            return np.full(len(names), float(self.sensitivity))
        for name in self.sensitivity:
            if name not in names:
                raise ValueError(f"sensitivity must be of the elements {', '.join(names)}, got {short_text(name)}")
        missing = [name for name in names if name not in self.sensitivity]
        if missing:
            raise ValueError(f"sensitivity must have a value for {missing[0]}, got {short_text(self.sensitivity)}")
        return np.array([float(self.sensitivity[name]) for name in names])

    def default_control(self) -> VoltageControl:
        """Control of the voltage if none is given: usual voltage pulses, or none with a laser."""
        return VoltageControl() if self.laser is None else VoltageControl(pulse_fraction=0.0)

    def working_point(self, sensitivity: float, control: VoltageControl) -> tuple[float, float]:
        """Barrier over kT at the wanted rate, and the time at the top of a pulse.

        Parameters
        ----------
        sensitivity : float
            C [eV].
        control : VoltageControl
            Rate and pulses.

        Returns
        -------
        barrier : float
            Q_op / kT.
        pulse_length : float
            Time per pulse with the rate of its top [s]; 0 without pulses.

        Notes
        -----
        For a laser the time is decay kT_peak^2/(Q_op dT), from the first order of 1/T; for voltage pulses see
        `VoltageControl.effective_width`.
        """
        thermal = BOLTZMANN * self.peak_temperature
        barrier, length = 20.0, 0.0
        for _ in range(_ROUNDS):
            if self.laser is not None:
                length = 1e-9 * self.laser.decay * self.peak_temperature / (barrier * self.laser.temperature_rise)
            elif control.pulse_fraction > 0:
                x = max(1.0 - barrier * thermal / sensitivity, 0.3)  # a field below a third would be another regime
                length = control.effective_width(thermal / (sensitivity * x))
            seconds = (length or 1.0) / control.rate
            barrier = max(float(logarithm(self.attempt_frequency * seconds * CANDIDATES)), 1.0)
        return barrier, length

    def cooling(self, tip: Tip, control: VoltageControl | None = None) -> Cooling:
        """Cooling after the laser pulses, for the tails of mass peaks: ``Timing(cooling=law.cooling(tip))``.

        Parameters
        ----------
        tip : Tip
            The specimen, whose first species gives the barrier.
        control : VoltageControl, optional
            Rate; by default that of the law.

        Returns
        -------
        Cooling
            That of the hottest side.

        Raises
        ------
        ValueError
            If the law has no laser.
        """
        if self.laser is None:
            raise ValueError(f"law must have a laser for its cooling, got {self}")
        barrier, _ = self.working_point(float(self.sensitivities(tip)[0]), control or self.default_control())
        return Cooling(self.temperature, self.laser.temperature_rise, self.laser.decay, barrier)

    def kernel(self, tip: Tip, control: VoltageControl | None = None) -> LawKernel:
        """Return the compiled law for a specimen."""
        weight = np.where(tip.evaporable, 1.0 / tip.evaporation_fields[tip.species], 0.0)
        more = () if self.bonds is None else bond_table(self.bonds, tip)
        if self.peak_temperature == 0:
            return WeightedField(weight, *more)
        sensitivities = self.sensitivities(tip)
        temperatures: Any = self.temperature
        if self.laser is not None:
            radius = tip.settings.get("apex_radius") or float(np.ptp(tip.positions[:, 0])) / 2.0
            temperatures = self.laser.temperatures(tip.positions, radius, self.temperature)
        stiffness = sensitivities[tip.species] / (BOLTZMANN * temperatures)
        reach, _ = self.working_point(float(sensitivities[0]), control or self.default_control())
        frequency = float(logarithm(self.attempt_frequency))
        return ThermalRate(weight, np.ascontiguousarray(stiffness), frequency, self.barrier, reach, *more)


LAWS = (Extremal, Arrhenius)
"""The built-in laws, the default first."""
