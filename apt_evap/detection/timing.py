"""Times of flight: from a time to a mass, and the errors of the measured times."""

from __future__ import annotations

from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike

from apt_evap._common.codec import choice, number, part, settings
from apt_evap._common.types import Floats
from apt_evap._common.validation import check_array, check_number, check_switch, check_values
from apt_evap._core.elementary import exponential, logarithm, normal_quantile
from apt_evap.units import BOLTZMANN, NM_PER_MM, SPEED

MASS_TO_CHARGE = (SPEED / NM_PER_MM) ** 2
"""2 e / Da in [Da mm^2 / (V ns^2)], 1.9297e-4: m/n = MASS_TO_CHARGE V t^2 / L^2."""

_NM2_PER_NS = 1e3  # in mm^2/s
# mean deficit: -log(2^-53) = 36.7 times the mean, for the smallest random number, is still below 1
_LARGEST_MEAN = 1 / 37


def mass_to_charge(
    voltage: ArrayLike,
    time_of_flight: ArrayLike,
    x: ArrayLike,
    y: ArrayLike,
    distance: float,
    *,
    curved: bool = False,
) -> Floats:
    """Mass-to-charge ratio of ions from their times of flight.

    Parameters
    ----------
    voltage : array_like
        Total voltage at the time of the evaporation [V], shape (n,) or a number.
    time_of_flight : array_like
        [ns], shape (n,).
    x, y : array_like
        Detector coordinates, seen from the axis of the specimen [mm], shape (n,).
    distance : float
        Distance from the apex to the detector [mm].
    curved : bool
        Whether the detector is a sphere around the apex, so that all paths have the length `distance`: a `Detector`
        with the equidistant projection. Otherwise it is a plane.

    Returns
    -------
    ndarray
        m/n [Da], shape (n,); NaN where an argument is NaN, such as the position of an ion that missed the plane.

    Raises
    ------
    ValueError
        If the distance is not positive.

    Notes
    -----
    m/n = 2 e V t^2 / L^2 = 1.9297e-4 V t^2 / L^2 [Da], with L^2 = distance^2 + x^2 + y^2 on a plane, as if an ion had
    its final speed from the start. The acceleration adds R / 2 (1 + ln(4 L / R)) to L for a sphere of radius R: 4e-6 of
    L for 50 nm and 100 mm.
    """
    distance = check_number(distance, "distance", above=0, unit="mm")
    columns = {"voltage": voltage, "time_of_flight": time_of_flight, "x": x, "y": y}
    voltage, time, x, y = (check_values(value, name, finite=False) for name, value in columns.items())
    across = x * x + y * y
    if check_switch(curved, "curved"):
        across = 0.0 * across  # keeps NaN
    return MASS_TO_CHARGE * voltage * time * time / (distance * distance + across)


DECAYS = ("exponential", "conduction")
_LAST = 60.0  # of the exponent of the rate over that at the peak: no ion leaves later
_LATEST = 3e3  # delays of first order: about the time to the next pulse
_POINTS = 4001  # of the table of delays, in proportion to the logarithm of 1 + time (measured: 1e-5 of a delay)


@settings
class Cooling:
    r"""Cooling of a specimen after a laser pulse, during which ions leave late: the tails of laser spectra.

    Notes
    -----
    With the temperature T(t) after the peak, ions leave with the density

    .. math:: p(t) \propto \exp\left(-\frac{Q}{k} \Bigl(\frac{1}{T(t)} - \frac{1}{T_\mathrm{peak}}\Bigr)\right) .

    The rate long after the pulse is subtracted: its ions are those between the pulses. The decay "exponential" is
    :math:`T_0 + \Delta T e^{-t/\tau}`, "conduction" :math:`T_0 + \Delta T/\sqrt{1 + t/\tau}`: the solution of the heat
    equation along a rod for a Gaussian zone with the standard deviation w, in its middle, with
    :math:`\tau = w^2/(2 D)` and the diffusivity D. Its tail is much longer. To first order both delays are exponential,
    with the mean :math:`\tau k T_\mathrm{peak}^2/(Q \Delta T)`, twice as long for "conduction".

    Examples
    --------
    >>> cooling = ae.detection.Cooling(temperature=50.0, temperature_rise=150.0, time_constant=2.0)
    >>> cooling.delays([0.5, 0.01]).round(2)  # ns, for the median and the last per cent
    array([0.09, 0.56])
    """

    temperature: float = number("Temperature before the pulse, and long after it.", above=0, at_most=5000, unit="K")
    temperature_rise: float = number("Rise at the peak.", above=0, at_most=5000, unit="K")
    time_constant: float = number(
        "Time constant tau. For a zone of 1 micrometre: 5 ns in aluminium (97 mm^2/s), 125 ns with 4 mm^2/s.",
        above=0,
        at_most=1e6,
        unit="ns",
    )
    barrier: float = number(
        "Barrier over kT at the peak, ln(nu_0 t N / n): 17 to 25, see `Arrhenius.working_point`.",
        default=20.0,
        above=0,
        at_most=1000,
    )
    decay: str = choice('"exponential", or "conduction" of the heat along the shank.', DECAYS, default="exponential")

    @classmethod
    def of_zone(
        cls, width: float, diffusivity: float, *, temperature: float, temperature_rise: float, barrier: float = 20.0
    ) -> Cooling:
        """Cooling by conduction from a heated zone along the shank.

        Parameters
        ----------
        width : float
            Standard deviation of the zone along the shank [nm]; of the order of the wavelength of the light.
        diffusivity : float
            Thermal diffusivity [mm^2/s].
        temperature, temperature_rise, barrier : float
            As for `Cooling`.

        Returns
        -------
        Cooling
            With the time constant width^2 / (2 diffusivity).

        Raises
        ------
        ValueError
            If a number is outside its range.
        """
        width = check_number(width, "width", above=0, at_most=1e6, unit="nm")
        diffusivity = check_number(diffusivity, "diffusivity", above=0, at_most=1e4, unit="mm^2/s")
        time_constant = width**2 / (2 * diffusivity * _NM2_PER_NS)
        return cls(temperature, temperature_rise, time_constant, barrier, "conduction")

    def temperatures(self, times: ArrayLike) -> Floats:
        """Temperature at times after the peak [ns], of the same shape [K]."""
        share = np.asarray(times, np.float64) / self.time_constant
        fall = exponential(-share) if self.decay == "exponential" else 1.0 / np.sqrt(1.0 + share)
        return self.temperature + self.temperature_rise * fall

    def delays(self, u: ArrayLike) -> Floats:
        """Times between the peak of the pulse and the departure.

        Parameters
        ----------
        u : array_like
            Uniform random numbers in (0, 1), shape (n,): the share of the ions that leave later.

        Returns
        -------
        ndarray
            [ns], shape (n,).
        """
        times, later = self._table
        return np.interp(-np.asarray(u, np.float64), -later, times)

    @cached_property
    def _table(self):
        """Times [ns] and share of the ions that leave later, by the trapezoidal rule in the logarithm of the time."""
        logarithms = np.linspace(0.0, float(logarithm(1.0 + _LATEST)), _POINTS)
        peak = self.temperature + self.temperature_rise
        # the logarithm is finest where ions leave: at the delay of first order
        unit = self.time_constant * peak / (self.barrier * self.temperature_rise)
        times = unit * (exponential(logarithms) - 1.0)
        # without the rate long after the pulse, which belongs to no pulse
        exponents = self.barrier * (peak / np.append(self.temperatures(times), self.temperature) - 1.0)
        rates = exponential(-np.minimum(exponents, _LAST))
        rates = np.maximum(rates[:-1] - rates[-1], 0.0)
        parts = np.diff(times) * (rates[1:] + rates[:-1]) / 2.0
        later = np.concatenate([np.cumsum(parts[::-1])[::-1], [0.0]])
        used = int(np.searchsorted(-later, 0.0)) + 1
        return times[:used], later[:used] / later[0]


@settings
class Timing:
    """Errors of the measured times of flight: energy deficits of voltage pulses, late ions of laser pulses, jitter.

    During a voltage pulse an ion can leave before or after the peak. It is then accelerated by V (1 - delta), with the
    deficit delta. Its measured time is t / sqrt(1 - delta) + delay, where t is the time of an ion without deficit. The
    instrument calculates m/n with the peak voltage V, and obtains (m/n) / (1 - delta): each peak has a tail to high
    masses. The slope of ln N per relative mass is -C / (k T) for deficits << 1. Field evaporation energy loss
    spectroscopy (FEELS) measures C from it.

    Notes
    -----
    The rate of evaporation falls as exp(-C delta / (k T)) below the peak of the pulse. If a pulse passes each voltage
    at the same speed, as a triangle does, delta has the density (C / k T) exp(-C delta / (k T)) with the mean k T / C,
    0.43 % at 50 K and 1 eV. A round top of the pulse would add a factor delta^(-1/2): smaller deficits, mean k T / 2 C.

    Source: "Introducing field evaporation energy loss spectroscopy", Commun. Phys. (2023), 10.1038/s42005-023-01203-2.
    """

    jitter: float = number("Standard deviation of the measured time.", default=0.2, at_least=0, unit="ns")
    temperature: float | None = number(
        "Temperature of the specimen. None for no deficits, for example with laser pulses.",
        default=None,
        above=0,
        unit="K",
    )
    sensitivity: float = number(
        "Sensitivity C of the barrier to the field: C = -dQ / d(ln F) of the energy barrier Q at the field of the "
        "evaporation. The mean deficit k T / C must be <= 1/37: the model is one of small deficits.",
        default=1.0,
        above=0,
        unit="eV",
    )
    cooling: Cooling | None = part(
        "Cooling after laser pulses, which delays ions; instead of the deficits of voltage pulses.",
        Cooling,
        default=None,
    )

    def _check(self):
        if self.cooling is not None and self.temperature is not None:
            raise ValueError(
                f"temperature is for voltage pulses and excludes cooling, got temperature={self.temperature:g} K and "
                f"{self.cooling}"
            )
        if self.temperature is not None:
            highest = _LARGEST_MEAN * self.sensitivity / BOLTZMANN
            why = "k T <= sensitivity / 37"
            check_number(self.temperature, "temperature", at_most=highest, unit="K", why=why)

    @property
    def mean_deficit(self) -> float:
        """Mean k T / C of the deficits, as a fraction of the voltage; 0 without a temperature."""
        return 0.0 if self.temperature is None else BOLTZMANN * self.temperature / self.sensitivity

    def errors(self, u: ArrayLike) -> tuple[Floats, Floats]:
        """Draw the errors of a batch of ions.

        Parameters
        ----------
        u : array_like
            Uniform random numbers in (0, 1), two per ion, shape (n, 2).

        Returns
        -------
        deficits : ndarray, shape (n,)
            Missing fraction of the voltage, >= 0.
        delays : ndarray, shape (n,)
            Errors of the measured time [ns], with the delay of the departure after a laser pulse.

        Raises
        ------
        ValueError
            If `u` does not have this shape or is not inside (0, 1).
        """
        u = check_array(u, "u", ("n", 2))
        if u.size and not 0 < u.min() <= u.max() < 1:
            raise ValueError(f"u must be in (0, 1), got {u.min()} to {u.max()}")
        delays = self.jitter * normal_quantile(u[:, 1])
        if self.cooling is not None:
            delays = delays + self.cooling.delays(u[:, 0])
        return -self.mean_deficit * logarithm(u[:, 0]), delays
