"""Image of the atoms of a specimen that leave in a run, seen from above or from the side."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from apt_evap._common.short_repr import short_repr
from apt_evap._common.types import Floats
from apt_evap._common.validation import check_choice, check_count
from apt_evap.simulation.run import Run

COLORED_BY = {"order": "number of the ion", "field": "field before leaving [V/nm]", "charge": "charge [e]"}
"""Quantities of an atom that can be its colour, with their titles."""
SIDES = {"above": (0, 1, 2), "side": (0, 2, 1)}
"""Axes to the right, upwards, and of the depth, for each side from which a specimen is seen."""
_PIXELS_PER_ATOM = 5.0
_MOST_PIXELS = 480  # along the longer side: 900 kB of float32, sent in about 10 ms


@dataclass(frozen=True, eq=False)
class SpecimenImage:
    """Atoms as discs of their nearest neighbour distance, front atoms over back atoms.

    Parameters
    ----------
    values : ndarray of float32, shape (ny, nx)
        Number, field [V/nm] or charge [e] of the front atom, indexed from below; NaN without an atom.
    extent : tuple of float
        Left, right, lower and upper end [nm].
    color : str
        One of `COLORED_BY`.
    side : str
        One of `SIDES`.
    """

    values: NDArray[np.float32]
    extent: tuple[float, float, float, float]
    color: str
    side: str

    def __repr__(self) -> str:
        return short_repr(self)

    def places(self, positions: Floats) -> Floats:
        """Places of atoms on the image [nm], shape (n, 2), from their positions [nm], shape (n, 3)."""
        return positions[:, SIDES[self.side][:2]]


def specimen_image(
    run: Run, color: str = "order", side: str = "above", ions: tuple[int, int] | None = None
) -> SpecimenImage:
    """Draw the atoms that leave in a run: the surface before the first of these ions.

    Parameters
    ----------
    run : Run
        The run.
    color : {"order", "field", "charge"}
        Quantity of the colour: number in the sequence; field and charge of the atom just before it left, at the
        simulated voltage.
    side : {"above", "side"}
        From where: along -z with x to the right and y upwards, or along y with x to the right and z upwards.
    ions : tuple of int, optional
        First ion, and the one after the last; by default all. Atoms that left before are not drawn.

    Returns
    -------
    SpecimenImage

    Raises
    ------
    ValueError
        If a name is unknown, or there is no ion.
    """
    check_choice(color, "color", COLORED_BY)
    right, up, depth = SIDES[check_choice(side, "side", SIDES)]
    numbers = run.emissions.ions
    rows = slice(None) if ions is None else slice(*np.searchsorted(numbers, ions))
    positions = run.emissions.positions[rows]
    check_count(len(positions), "number of ions", at_least=1)
    values = {"order": numbers, "field": run.fields, "charge": run.charges}[color][rows]
    diameter = run.emissions.nearest_neighbour_distance
    low, high = (end(positions[:, [right, up]], axis=0) for end in (np.min, np.max))
    low, high = low - diameter, high + diameter
    pixel = max(diameter / _PIXELS_PER_ATOM, float(max(high - low)) / _MOST_PIXELS)
    nx, ny = (int(number) for number in np.ceil((high - low) / pixel))
    # y points away from a viewer at the side
    order = np.argsort(positions[:, depth] if side == "above" else -positions[:, depth], kind="stable")
    columns, lines = ((positions[order][:, [right, up]] - low) / pixel).T
    reach = int(diameter / 2 / pixel) + 1
    step = range(-reach, reach + 1)
    steps = np.array([(i, j) for i in step for j in step if np.hypot(i, j) * pixel <= diameter / 2] or [(0, 0)])
    column = columns.astype(np.intp)[:, None] + steps[:, 0]
    line = lines.astype(np.intp)[:, None] + steps[:, 1]
    image = np.full(ny * nx, np.nan, np.float32)
    # where atoms overlap, the last assignment is that of the front atom; the margin holds all discs
    image[(np.clip(line, 0, ny - 1) * nx + np.clip(column, 0, nx - 1)).ravel()] = np.repeat(
        values[order].astype(np.float32), len(steps)
    )
    extent = float(low[0]), float(low[0] + nx * pixel), float(low[1]), float(low[1] + ny * pixel)
    return SpecimenImage(image.reshape(ny, nx), extent, color, side)
