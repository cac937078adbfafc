"""The choice of conditions: ions that leave between the pulses, and what they do to a measured composition."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from apt_evap._common.codec import changed
from apt_evap._common.types import Floats
from apt_evap._common.validation import check_kind, check_number, check_values, short_text
from apt_evap.evaporation.thermal import Arrhenius
from apt_evap.evaporation.voltage import VoltageControl
from apt_evap.units import BOLTZMANN


class Conditions(NamedTuple):
    """Losses between pulses over temperature and pulse fraction; made by `conditions`."""

    elements: tuple[str, ...]
    """Names of the k elements."""
    composition: Floats
    """True fractions of the elements, shape (k,)."""
    temperatures: Floats
    """[K], shape (n,)."""
    pulse_fractions: Floats
    """Shape (m,)."""
    lost: Floats
    """Share of the ions of each element that leave between pulses, shape (k, n, m)."""
    measured: Floats
    """Measured fractions, shape (k, n, m)."""

    @property
    def bias(self) -> Floats:
        """Measured minus true fraction, shape (k, n, m)."""
        return self.measured - self.composition[:, None, None]

    def __repr__(self) -> str:
        names = ", ".join(f"{name} {share:.3g}" for name, share in zip(self.elements, self.composition, strict=True))
        (low_t, high_t), (low_p, high_p) = ((axis.min(), axis.max()) for axis in self[2:4])
        return f"<Conditions: {names}; {low_t:g} to {high_t:g} K, pulse fractions {low_p:g} to {high_p:g}>"


def conditions(
    composition: Mapping[str, float],
    *,
    temperatures: ArrayLike = (20.0, 30.0, 40.0, 50.0, 60.0, 70.0, 80.0, 100.0),
    pulse_fractions: ArrayLike = (0.10, 0.15, 0.20, 0.25, 0.30),
    law: Arrhenius | None = None,
    control: VoltageControl | None = None,
) -> Conditions:
    r"""Ions that are lost between voltage pulses, and the bias of the measured composition.

    Parameters
    ----------
    composition : mapping
        Fractions by element, with the sum 1.
    temperatures : array_like
        Temperatures of the specimen [K], shape (n,).
    pulse_fractions : array_like
        Heights of the pulses relative to the standing voltage, > 0, shape (m,).
    law : Arrhenius, optional
        Sensitivity, for all elements or by element, attempt frequency and form of the barrier; its temperature is not
        used. By default ``Arrhenius(50.0)``, with 1 eV for all elements.
    control : VoltageControl, optional
        Rate, width and frequency of the pulses; its pulse fraction is not used.

    Returns
    -------
    Conditions

    Raises
    ------
    ValueError
        If the fractions are not positive with the sum 1, a number is outside its range, an element has no sensitivity,
        or the law has a laser.

    Notes
    -----
    An atom leaves at the top of a pulse when its barrier is :math:`Q_\mathrm{op} = k T \ln(\nu_0 \tau N / n)`
    (`Arrhenius.working_point`), at the field :math:`x = F/F_\mathrm{evap}` that follows from its sensitivity C: for the
    linear barrier :math:`x = 1 - Q_\mathrm{op}/C`. Between pulses the field is :math:`x/(1+p)`. For each ion that
    leaves in a pulse,

    .. math::

       \rho = \frac{1}{f \tau} \exp\left(-\frac{Q(x/(1+p)) - Q(x)}{k T}\right)

    ions leave at the standing voltage, with the pulse frequency f and the integral :math:`\tau` of the rate over a
    pulse, divided by that at its top; the exponent is :math:`-C x p / ((1+p) k T)` for the linear barrier. The share
    :math:`\rho/(1+\rho)` is lost, and of the fractions c those proportional to :math:`c/(1+\rho)` are measured: in a
    steady state the atoms of all elements leave as often as they are there.

    Differences of the evaporation fields do not enter: every atom leaves at its own field. :doc:`/conditions` compares
    with a simulation that has explicit times, and different fields.

    Examples
    --------
    >>> law = ae.Arrhenius(50.0, sensitivity={"Al": 1.0, "Cu": 0.6})
    >>> losses = ae.evaporation.conditions({"Al": 0.9, "Cu": 0.1}, temperatures=[50.0, 80.0], law=law)
    >>> losses
    <Conditions: Al 0.9, Cu 0.1; 50 to 80 K, pulse fractions 0.1 to 0.3>
    >>> losses.measured[1, :, 2].round(3)  # of Cu at 50 and 80 K, pulse fraction 0.2
    array([0.1 , 0.09])
    """
    check_kind(composition, "composition", Mapping, "a mapping of elements to fractions")
    elements = tuple(composition)
    shares = np.array([check_number(composition[name], f"composition of {name}", above=0) for name in elements])
    if not math.isclose(shares.sum(), 1.0, abs_tol=1e-6):
        raise ValueError(f"composition must have the sum 1, got {shares.sum():g}")
    law = Arrhenius(50.0) if law is None else check_kind(law, "law", Arrhenius, "an Arrhenius")
    if law.laser is not None:
        raise ValueError(f"law must not have a laser: the standing voltage is then that of the pulse, got {law.laser}")
    control = (
        VoltageControl() if control is None else check_kind(control, "control", VoltageControl, "a VoltageControl")
    )
    kelvins = np.atleast_1d(check_values(temperatures, "temperatures"))
    heights = np.atleast_1d(check_values(pulse_fractions, "pulse_fractions"))
    for values, name, most, unit in ((kelvins, "temperatures", 5000.0, "K"), (heights, "pulse_fractions", 1.0, "")):
        for value in values:
            check_number(float(value), name, above=0, at_most=most, unit=unit)

    # ratio rho of the ions at the standing voltage to those in pulses; rho / (1 + rho) of an element are lost
    ratios = np.empty((len(elements), len(kelvins), len(heights)))
    for k, name in enumerate(elements):
        sensitivity = _sensitivity(law.sensitivity, name)
        for i, kelvin in enumerate(kelvins):
            for j, height in enumerate(heights):
                at = changed(law, {"temperature": float(kelvin), "bonds": None})
                pulses = changed(control, {"pulse_fraction": float(height)})
                ratios[k, i, j], _ = between_pulses(sensitivity, at, pulses)
    kept = shares[:, None, None] / (1.0 + ratios)
    lost = ratios / (1.0 + ratios)
    return Conditions(elements, shares, kelvins, heights, lost, kept / kept.sum(axis=0))


def between_pulses(sensitivity: float, law: Arrhenius, control: VoltageControl) -> tuple[float, float]:
    """Ions at the standing voltage for each ion in a pulse, and the field x of the working point; C is in eV."""
    reach, _ = law.working_point(sensitivity, control)
    stiffness = sensitivity / (BOLTZMANN * law.temperature)
    x = _field_of(law.barrier, stiffness, reach)
    p, times = control.pulse_fraction, np.linspace(-_PULSE, _PULSE, _POINTS)
    fields = x * (1.0 + p * np.exp(-0.5 * times**2)) / (1.0 + p)
    rates = np.exp(np.clip(reach - _barrier(law.barrier, stiffness, reach, fields), -_LARGEST, _LARGEST))
    resting = rates[0]
    length = 1e-9 * control.pulse_width * np.trapezoid(rates - resting, times)
    return float(resting / (1e3 * control.pulse_frequency * length)), x


_PULSE, _POINTS = 9.0, 2001  # standard deviations, and points of the integral over a pulse
_LARGEST = 700.0  # exp(700) is still a number
_SMALLEST = 1e-3  # of x: a barrier that is not high enough at any field


def _barrier(form, stiffness, reach, x):
    """Q / kT at the fields x."""
    if form == "linear":
        return stiffness * (1.0 - x)
    if form == "image_hump":
        return 2.0 * stiffness * (1.0 - np.sqrt(x))
    missing = 1.0 / x - 1.0 if form == "parabolic" else 1.0 - x
    return stiffness**2 / (4.0 * reach) * missing * np.abs(missing)


def _field_of(form, stiffness, reach):
    """Field x at which the barrier is `reach`, at least 0.001."""
    share = reach / stiffness
    if form == "linear":
        x = 1.0 - share
    elif form == "image_hump":
        x = max(1.0 - share / 2.0, 0.0) ** 2
    else:
        x = 1.0 / (1.0 + 2.0 * share) if form == "parabolic" else 1.0 - 2.0 * share
    return max(x, _SMALLEST)


def _sensitivity(sensitivity: Any, name: str) -> float:
    if not isinstance(sensitivity, Mapping):
        return float(sensitivity)
    if name not in sensitivity:
        raise ValueError(f"sensitivity must have a value for {name}, got {short_text(sensitivity)}")
    return float(sensitivity[name])
