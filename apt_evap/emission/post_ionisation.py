"""Post-ionisation: the charge of the ion that flies, from the field at its site.

An atom leaves with the charge state n of the barrier. In the high field within a nanometre of the surface it can lose
further electrons by tunnelling (Kingham, Surf. Sci. 116, 273 (1982)). Tegg, Stephenson and Cairney, Microsc. Microanal.
30, 466 (2024), fitted Kingham's curves of the charge state ratio CSR = N(n + 1) / N(n), the ratio of the numbers of
ions, as a function of the field F::

    F = a (1 - b / (CSR^0.3 + b + 0.256))        CSR = (a b / (a - F) - b - 0.256)^(10/3)

CSR is 0 below F = 0.256 a / (b + 0.256), and infinite from F = a. It grows about as F^30 where it is 1.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike, NDArray

from apt_evap._common.codec import number, settings
from apt_evap._common.types import Floats
from apt_evap._common.validation import (
    check_array,
    check_choice,
    check_count,
    check_number,
    check_sequence,
    check_values,
)
from apt_evap._core.elementary import exponential, logarithm

RATIO_PARAMETERS: dict[str, tuple[tuple[float, float], ...]] = {
    "Mg": ((19.75, 0.2045),),
    "Al": ((29.99, 0.2196), (48.36, 0.1939)),
    "Si": ((23.00, 0.2094), (65.71, 0.2049), (92.78, 0.1893)),
    "Ti": ((16.24, 0.1968), (45.33, 0.1916), (85.58, 0.1841)),
    "Cr": ((23.34, 0.2098), (56.59, 0.1991), (108.9, 0.1933)),
    "Fe": ((22.54, 0.2080), (55.42, 0.1980)),
    "Co": ((24.85, 0.2112), (65.41, 0.2038)),
    "Ni": ((28.52, 0.2209), (73.31, 0.2123)),
    "Cu": ((34.17, 0.2229), (78.01, 0.2099)),
    "Mo": ((22.37, 0.2071), (43.91, 0.1893), (74.40, 0.1782)),
    "Rh": ((27.53, 0.2143), (56.56, 0.1979)),
    "Ag": ((37.89, 0.2261),),
    "Ta": ((22.30, 0.2054), (32.17, 0.1777), (56.44, 0.1680)),
    "W": ((22.72, 0.2061), (40.21, 0.1849), (66.63, 0.1733)),
    "Ir": ((24.35, 0.2082), (46.19, 0.1894), (72.63, 0.1760)),
    "Pt": ((28.66, 0.2141), (49.33, 0.1917), (83.27, 0.1805)),
    "Au": ((33.55, 0.2199), (52.56, 0.1938), (90.73, 0.1834)),
    # not in the fit: from the second ionisation energy I [eV] of NIST, see `RATIO_PARAMETERS`
    "Be": ((27.91, 0.2152),),
    "V": ((18.64, 0.2011),),
    "Mn": ((21.08, 0.2054),),
    "Zn": ((27.22, 0.2143),),
    "Ga": ((34.78, 0.2229),),
    "Ge": ((21.82, 0.2066),),
    "Zr": ((15.26, 0.1941),),
    "Nb": ((17.91, 0.1997),),
    "Ru": ((23.95, 0.2098),),
    "Pd": ((31.46, 0.2194),),
    "Sn": ((18.64, 0.2011),),
    "Hf": ((18.59, 0.2010),),
    "Re": ((23.53, 0.2092),),
    "Os": ((24.58, 0.2108),),
    "Pb": ((19.59, 0.2028),),
}
"""a [V/nm] and b of the fit, by element, for the steps 1 to 2, 2 to 3 and 3 to 4.

The elements from Be on are not in the fit. Their first step is estimated, a = 0.1316 I^1.846 and b = 0.0283 + 0.0644 ln
I, with the second ionisation energy I [eV]. For the 17 elements of the fit this gives a within 1.1 %, nickel 2.7 %.
"""

_OFFSET = 0.256
_POWER = 0.3

FLIGHT_CHARGES = {
    "Mg": 2,
    "Al": 1,
    "Si": 2,
    "Ti": 2,
    "Cr": 2,
    "Fe": 2,
    "Co": 2,
    "Ni": 2,
    "Cu": 1,
    "Mo": 3,
    "Rh": 2,
    "Ag": 1,
    "Ta": 3,
    "W": 3,
    "Ir": 2,
    "Pt": 2,
    "Au": 1,
}
"""Dominant charge of the ions in voltage-pulsed spectra [e], by element.

Rules of thumb (Miller and Forbes, Atom-Probe Tomography, Springer 2014, appendix tables of observed charge states). The
charge depends on the field, and with it on temperature and detection rate: the user's own spectrum decides.
"""


def charge_state_ratio(element: str, charge: int, field: ArrayLike) -> Floats:
    """Ratio of the numbers of ions with charge + 1 and charge, N(charge + 1) / N(charge).

    Parameters
    ----------
    element : str
        Chemical symbol, one of `RATIO_PARAMETERS`.
    charge : int
        Lower charge of the two [e].
    field : array_like
        Field [V/nm] on the scale of Kingham's curves, any shape.

    Returns
    -------
    ndarray
        Ratio, in the shape of `field`; 0 below the range of the fit, inf above it.

    Raises
    ------
    ValueError
        If the fit has no such element or charge, or a field is not finite.

    Notes
    -----
    CSR = (a b / (a - F) - b - 0.256)^(10/3), the inverse of the fit by Tegg et al. (2024).
    """
    a, b = _parameters(element, charge)
    field = check_values(field, "field")
    below = field < a
    excess = a * b / np.where(below, a - field, a) - (b + _OFFSET)
    return np.where(below, _power(np.maximum(excess, 0.0), 1 / _POWER), np.inf)[()]


def field_of_ratio(element: str, charge: int, ratio: ArrayLike) -> Floats:
    """Field at which the numbers of ions with charge + 1 and charge have a ratio: inverse of `charge_state_ratio`.

    Parameters
    ----------
    element : str
        Chemical symbol, one of `RATIO_PARAMETERS`.
    charge : int
        Lower charge of the two [e].
    ratio : array_like
        N(charge + 1) / N(charge) >= 0, any shape.

    Returns
    -------
    ndarray
        Field [V/nm], in the shape of `ratio`. A ratio of 0 gives the lower end of the range of the fit, inf the upper.

    Raises
    ------
    ValueError
        If the fit has no such element or charge, or a ratio is negative or NaN.

    Notes
    -----
    F = a (1 - b / (CSR^0.3 + b + 0.256)), Tegg et al. (2024).
    """
    a, b = _parameters(element, charge)
    ratio = check_values(ratio, "ratio", finite=False)
    if not (ratio >= 0).all():
        raise ValueError(f"ratio must be >= 0, got {np.min(ratio)}")
    return a * (1 - b / (_power(ratio, _POWER) + b + _OFFSET))


def charge_probabilities(element: str, field: ArrayLike, least: int = 1) -> Floats:
    """Probabilities of the charges of an ion after post-ionisation, shape (n, k), each row with the sum 1.

    The charges are `least` [e], `least` + 1, ... up to the highest of the fit. An atom of an element of
    `RATIO_PARAMETERS` leaves with the charge `least`, at a field (n,) [V/nm] on the scale of Kingham's curves. p(n) is
    proportional to the product of the ratios CSR(m) of the charges m from `least` to n - 1.
    """
    reached, stay = _chain(element, check_array(field, "field", ("n",)), least)
    return reached * stay


@settings
class PostIonisation:
    """Charges of the ions in flight, drawn from the field at each site.

    The fields of Kingham's curves and of a simulation have different scales: the evaporation fields of `MATERIALS`
    come from other models, and the field at a site is higher than the apex mean. `field_scale` connects the two.

    * Measured spectrum: use `calibrated` with the ratio of the two peaks and the field of the simulated ions. A ratio
      Ni2+/Ni+ of 10, for example, is a field of 26.0 V/nm on Kingham's scale. If the simulated ions leave at the
      evaporation field of Ni, 35 V/nm, the scale is 0.74.
    * Evaporation field derived from a charge state ratio: it is on Kingham's scale already, keep 1.
    * No measurement: 1. The mean charge can then be wrong: at 35 V/nm no Ni+ is left, at 48 V/nm no Pt2+.

    Notes
    -----
    The ratio grows about as the 30th power of the field. An error of 1 % in the scale changes it by a third.
    """

    field_scale: float = number(
        "Field on Kingham's scale divided by the field of the simulation.", default=1.0, above=0
    )

    @classmethod
    def calibrated(cls, element: str, charge: int, ratio: float, field: float) -> PostIonisation:
        """Post-ionisation with the scale that gives a measured charge state ratio.

        Parameters
        ----------
        element : str
            Chemical symbol, one of `RATIO_PARAMETERS`.
        charge : int
            Lower charge of the two peaks [e].
        ratio : float
            Measured N(charge + 1) / N(charge), > 0.
        field : float
            Field of the simulated ions [V/nm], for example the evaporation field of the material.

        Returns
        -------
        PostIonisation

        Raises
        ------
        ValueError
            If the fit has no such element or charge, or a number is not positive.
        """
        ratio = check_number(ratio, "ratio", above=0)
        field = check_number(field, "field", above=0, unit="V/nm")
        return cls(float(field_of_ratio(element, charge, ratio)) / field)

    def draw(
        self, names: Sequence[str], species: ArrayLike, least: ArrayLike, fields: ArrayLike, u: ArrayLike
    ) -> NDArray[np.int32]:
        """Draw the charge of each ion.

        Parameters
        ----------
        names : sequence of str
            Name of each species.
        species : array_like of int
            Species of each ion, shape (n,).
        least : array_like of int
            Charge state with which each species leaves [e], shape (number of species,). A species whose name is not in
            `RATIO_PARAMETERS`, or whose charge state is at or above the highest of the fit, keeps it.
        fields : array_like
            Field at the site of each ion [V/nm], shape (n,).
        u : array_like
            Uniform random numbers in (0, 1), one per ion, shape (n,).

        Returns
        -------
        ndarray of int32
            Charge of each ion [e], shape (n,). For the same `u` it never falls as the field grows.

        Raises
        ------
        ValueError
            If shapes disagree, a field is not finite, or a species, a charge state or a random number is outside its
            range.
        """
        names = check_sequence(names, "names", "element names")
        least = check_array(least, "least", (len(names),), dtype=np.int32)
        if least.size and least.min() < 1:
            raise ValueError(f"least must be >= 1 [e], got {least.min()}")
        species = check_array(species, "species", ("n",), dtype=np.int64)
        fields = check_array(fields, "fields", (len(species),))
        u = check_array(u, "u", (len(species),))
        if species.size and not 0 <= species.min() <= species.max() < len(names):
            raise ValueError(f"species must be from 0 to {len(names) - 1}, got {species.min()} to {species.max()}")
        if u.size and not 0 < u.min() <= u.max() < 1:
            raise ValueError(f"u must be in (0, 1), got {u.min()} to {u.max()}")
        charges = least[species]
        for index, name in enumerate(names):
            if name in RATIO_PARAMETERS and least[index] <= len(RATIO_PARAMETERS[name]):
                ions = np.flatnonzero(species == index)
                reached, _ = _chain(name, self.field_scale * fields[ions], int(least[index]))
                charges[ions] += (u[ions, None] < reached[:, 1:]).sum(axis=1, dtype=np.int32)
        return charges


def _parameters(element, charge):
    """Parameters a [V/nm] and b of the fit for one step."""
    steps = RATIO_PARAMETERS[check_choice(element, "element", RATIO_PARAMETERS)]
    return steps[check_count(charge, f"charge of {element}", at_least=1, at_most=len(steps)) - 1]


def _chain(element, field, least):
    """Probabilities, shapes (n, k), that an ion has at least a charge, and that it then has no higher one."""
    steps = len(RATIO_PARAMETERS[check_choice(element, "element", RATIO_PARAMETERS)])
    least = check_count(least, f"least charge of {element}", at_least=1, at_most=steps + 1)
    # ions with a higher charge per ion with the charge, from the highest charge downwards
    further = np.zeros((len(field), steps + 2 - least))
    reached = np.ones_like(further)
    # a ratio may be 0 or infinite; 0 * inf: no ion has the higher charge
    with np.errstate(divide="ignore", over="ignore", invalid="ignore"):
        for charge in range(steps, least - 1, -1):
            column = charge - least
            ratio = charge_state_ratio(element, charge, field)
            further[:, column] = np.where(ratio > 0, ratio * (1 + further[:, column + 1]), 0.0)
        for column in range(1, reached.shape[1]):
            reached[:, column] = reached[:, column - 1] / (1 + 1 / further[:, column - 1])
    return reached, 1 / (1 + further)


def _power(x, exponent):
    """x^exponent for x >= 0, with the same bits on every machine."""
    inside = (x > 0) & (x < np.inf)
    return np.where(inside, exponential(exponent * logarithm(np.where(inside, x, 1.0))), x)
