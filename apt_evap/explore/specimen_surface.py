"""The outer atoms of a specimen that leave in a run, with a quantity of every atom for its colour."""

from typing import NamedTuple

import numpy as np
import scipy

from apt_evap._common.short_repr import short_repr
from apt_evap._common.types import Floats
from apt_evap._common.validation import check_choice, check_count
from apt_evap.simulation.run import Run

COLORED_BY = {
    "order": "number of the ion",
    "field": "field before leaving [V/nm]",
    "charge": "charge [e]",
    "phase": "phase",
}
"""Quantities of an atom that can be its colour, with their titles."""
MOST = 40_000
"""Atoms at most, those of the largest z."""
_SHELL = 1.5  # nearest neighbour distances: within it are the two first shells of neighbours of bcc and fcc


class SurfaceAtoms(NamedTuple):
    """Atoms on the surface of a specimen."""

    positions: Floats
    """Positions [nm], shape (n, 3)."""
    values: Floats
    """Number, field [V/nm], charge [e] or index of the phase of each atom, shape (n,)."""
    diameter: float
    """Nearest neighbour distance [nm]."""

    def __repr__(self) -> str:
        return short_repr(self)


def surface_atoms(run: Run, color: str = "order", ions: tuple[int, int] | None = None) -> SurfaceAtoms:
    """Select the atoms on the surface of those that leave in a run, before the first of these ions.

    Notes
    -----
    On the surface are atoms that lack a neighbour within 1.5 nearest neighbour distances: 0.98 to 1 of those that are
    seen from above and from four sides (W and Ni, R = 20 and 50 a, with spheres that overlap a little). The lower side
    of the volume that leaves counts as well.

    Examples
    --------
    >>> run = ae.Simulation(ae.Tip("Ni", apex_radius=2.0), seed=1).run(100, progress=False)
    >>> from apt_evap.explore.specimen_surface import surface_atoms
    >>> atoms = surface_atoms(run, "field")
    >>> atoms.positions.shape == (len(atoms.values), 3)
    True
    """
    check_choice(color, "color", COLORED_BY)
    numbers = run.emissions.ions
    rows = slice(None) if ions is None else slice(*np.searchsorted(numbers, ions))
    positions = run.emissions.positions[rows]
    check_count(len(positions), "number of ions", at_least=1)
    values = {"order": numbers, "field": run.fields, "charge": run.charges, "phase": run.phase}[color][rows]
    diameter = run.emissions.nearest_neighbour_distance
    neighbours = scipy.spatial.cKDTree(positions).query_ball_point(positions, _SHELL * diameter, return_length=True)
    outer = np.flatnonzero(neighbours < max(np.percentile(neighbours, 95), 2))
    if len(outer) > MOST:
        outer = outer[np.argsort(-positions[outer, 2], kind="stable")[:MOST]]
    return SurfaceAtoms(positions[outer], np.asarray(values[outer], float), diameter)
