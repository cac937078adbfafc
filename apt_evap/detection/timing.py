"""Times of flight: from a time to a mass, and the errors of the measured times."""

from __future__ import annotations  # help() then shows ArrayLike instead of its ten types

import numpy as np
from numpy.typing import ArrayLike

from apt_evap._common.codec import number, settings
from apt_evap._common.types import Floats
from apt_evap._common.validation import check_array, check_number, check_switch
from apt_evap._core.elementary import logarithm, normal_quantile
from apt_evap.units import BOLTZMANN, NM_PER_MM, SPEED

MASS_TO_CHARGE = (SPEED / NM_PER_MM) ** 2
"""2 e / Da in [Da mm^2 / (V ns^2)], 1.9297e-4: m/n = MASS_TO_CHARGE V t^2 / L^2."""

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
    voltage, time, x, y = (np.asarray(value, dtype=np.float64) for value in (voltage, time_of_flight, x, y))
    across = x * x + y * y
    if check_switch(curved, "curved"):
        across = 0.0 * across  # keeps NaN
    return MASS_TO_CHARGE * voltage * time * time / (distance * distance + across)


@settings
class Timing:
    """Errors of the measured times of flight: energy deficits of voltage pulses, and jitter.

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

    def _check(self):
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
            Errors of the measured time [ns].

        Raises
        ------
        ValueError
            If `u` does not have this shape or is not inside (0, 1).
        """
        u = check_array(u, "u", ("n", 2))
        if u.size and not 0 < u.min() <= u.max() < 1:
            raise ValueError(f"u must be in (0, 1), got {u.min()} to {u.max()}")
        return -self.mean_deficit * logarithm(u[:, 0]), self.jitter * normal_quantile(u[:, 1])
