"""Density of reconstructed ions over the cap, relative to that of a cap that recedes evenly."""

import math
from dataclasses import dataclass, field

import numpy as np

from apt_evap._common.types import Floats, Integers
from apt_evap._common.validation import check_count


@dataclass(frozen=True, eq=False)
class CapDensity:
    """Number of ions over its expectation, in square cells of x / R and y / R.

    Parameters
    ----------
    edges : ndarray
        Edges of the cells along each axis, in units of the radius of the cap, shape (n + 1,).
    ions : ndarray of int
        Number of ions, shape (n, n), indexed [y, x].
    expected : ndarray
        Expected number of ions, shape (n, n); NaN for a cell that is not completely within the field of view.
    """

    edges: Floats = field(repr=False)
    ions: Integers = field(repr=False)
    expected: Floats = field(repr=False)

    @property
    def values(self) -> Floats:
        """Ions over expected ions, shape (n, n): 1 without an artefact of the density; NaN outside."""
        return self.ions / self.expected

    @property
    def contrast(self) -> float:
        """Standard deviation of the density over its mean, without the noise of the counts."""
        inside = np.isfinite(self.expected)
        ions, expected = self.ions[inside], self.expected[inside]
        return math.sqrt(max(0.0, float((((ions - expected) ** 2 - expected) / expected**2).mean())))

    def __repr__(self) -> str:
        n = len(self.edges) - 1
        return f"<CapDensity: {self.ions.sum():,} ions in {n} x {n} cells; contrast {self.contrast:.2f}>"


def density_of(places: Floats, rim: float, widening: float, bins: int) -> CapDensity:
    r"""Density of ions on the cap, from their places x / R and y / R, shape (n, 2).

    `rim` is the sine of the angle at the rim of the field of view, `widening` w = dR / dz. A cap that recedes by dz and
    widens by w dz sweeps the volume :math:`R^2 [\cos\theta - w (1-\cos\theta)] dz` per solid angle. The area in x / R
    and y / R is :math:`\cos\theta` times the solid angle. The expectation is scaled to the number of ions in the cells
    that are completely within the field of view.
    """
    bins = check_count(bins, "bins", at_least=1, at_most=10_000)
    edges = np.linspace(-rim, rim, bins + 1)
    ions = np.histogram2d(places[:, 1], places[:, 0], (edges, edges))[0].astype(np.int64)
    outer = np.maximum(np.abs(edges[:-1]), np.abs(edges[1:]))
    centres = (edges[:-1] + edges[1:]) / 2
    squares = centres**2 + centres[:, None] ** 2
    inside = outer**2 + outer[:, None] ** 2 <= rim * rim
    cosine = np.sqrt(np.where(inside, 1 - squares, 1.0))
    weights = np.where(inside, 1 - widening * (1 - cosine) / cosine, np.nan)
    return CapDensity(edges, ions, weights * ions[inside].sum() / np.nansum(weights))
