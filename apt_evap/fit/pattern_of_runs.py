"""A master pattern from runs: the density of hits in every direction of their crystal.

Every simulated direction is folded by the point group of the crystal, so that one run along any axis covers the sphere:
each ion counts 48 times for the cubic lattices. The density of one run falls with the angle from its axis, smoothly.
The pattern is what remains after division by this decrease.
"""

import math
from collections.abc import Sequence
from functools import cache

import numpy as np

from apt_evap._common.types import Floats
from apt_evap._common.validation import check_kind, check_sequence
from apt_evap.emission.perturbations import Perturbation
from apt_evap.maps.crystallography.orientation import Orientation
from apt_evap.maps.indexing.master_pattern import HALF, PIXEL, MasterPattern, sampled
from apt_evap.simulation.apex import image_compression
from apt_evap.simulation.run import Run
from apt_evap.specimen.symmetry import point_group

_WIDEST = 50.0  # degrees from the axis of the tip: farther out are ions from the shank
_ROUNDS = 6  # of density and decrease in turn: the last changes are below 0.1 %
_DEGREE = 3  # of the decrease, in the squared sine of the polar angle


@cache
def _grid() -> Floats:
    """Directions of all pixels, shape ((2 HALF + 1)^2, 3); beyond the equator they are on the other hemisphere."""
    steps = np.arange(-HALF, HALF + 1) * PIXEL
    x, y = (axis.ravel() for axis in np.meshgrid(steps, steps))
    z = 1 - (x * x + y * y) / 2
    stretch = np.sqrt(np.maximum((1 + z) / 2, 0))
    return np.column_stack([x * stretch, y * stretch, z])


def master_pattern(runs: Sequence[Run] | Run, emissions: Sequence[Perturbation] | None = None) -> MasterPattern:
    """Make a master pattern from runs of one pure crystal.

    Parameters
    ----------
    runs : Run or sequence of Run
        Runs of one material and radius along any axes.
    emissions : sequence of Perturbation, optional
        Two emissions: of ions that do not roll up, and of ions that do. By default the first two that were flown
        in each run.

    Returns
    -------
    MasterPattern

    Raises
    ------
    ValueError
        If the runs are of different crystals, or too short for an image compression (`image_compression`).

    Notes
    -----
    The hits in directions v of tips with the orientation M have the density ``s(theta) D(g M^T v)`` for all members
    g of the point group. D, the counts over the sum of s, and s, a polynomial in sin^2 theta up to 50 degrees, are
    computed in turn.
    """
    runs = (runs,) if isinstance(runs, Run) else check_sequence(runs, "runs", "Runs")
    for run in runs:
        check_kind(run, "runs", Run, "Runs")
    pairs = [run.perturbations[:2] if emissions is None else emissions for run in runs]
    if not pairs or any(len(check_sequence(pair, "emissions", "two perturbations")) != 2 for pair in pairs):
        raise ValueError("a master pattern needs runs with two emissions: without and with roll-up")
    orientations = [Orientation.from_settings(run.settings["tip"]) for run in runs]
    material = orientations[0].material
    sizes = [round(run.settings["tip"]["apex_radius"] / material.a, 6) for run in runs]
    if any(orientation.material != material for orientation in orientations) or len(set(sizes)) > 1:
        raise ValueError("runs of a master pattern must be of one material and radius")
    views = []
    for run, orientation, pair in zip(runs, orientations, pairs, strict=True):
        projection = image_compression(run).projection
        hits = [run.hits(perturbation) for perturbation in pair]
        places = [np.column_stack([hits_of_one.x, hits_of_one.y])[hits_of_one.detected] for hits_of_one in hits]
        views.append((orientation.matrix, [projection.directions(xy) for xy in places]))
    densities = np.stack(
        [_folded(material.structure, [(matrix, directions[k]) for matrix, directions in views]) for k in (0, 1)]
    )
    return MasterPattern(material.structure, sizes[0], densities, sum(len(run) for run in runs))


def _folded(structure: str, views: Sequence[tuple[Floats, Floats]]) -> Floats:
    """Density over the sphere, folded, of directions (n, 3) of tips with the rotation matrices (3, 3)."""
    group, grid = point_group(structure), _grid()
    side = 2 * HALF + 1
    edges = (np.arange(side + 1) - HALF - 0.5) * PIXEL
    hemisphere = np.hypot(*(np.indices((side, side)) - HALF)) * PIXEL < math.sqrt(2)
    lowest = math.cos(math.radians(_WIDEST))
    counts = np.zeros((side, side))
    cosines, kept = [], []
    for matrix, directions in views:
        directions = directions[directions[:, 2] > lowest]
        kept.append(directions)
        for member in group:
            folded = directions @ (matrix @ member)
            x, y, z = folded.T
            stretch = np.sqrt(2 / np.maximum(1 + z, 1e-9))
            counts += np.histogram2d(y * stretch, x * stretch, (edges, edges))[0]
        cosines.append([grid @ (matrix @ member).T[:, 2] for member in group])
    bins = np.linspace(0, 1 - lowest**2, 21)
    middle = (bins[:-1] + bins[1:]) / 2
    decrease = [np.array([1.0] + [0.0] * _DEGREE) for _ in views]
    density = counts
    for _ in range(_ROUNDS):
        exposure = np.zeros(len(grid))
        for polynomial, cosines_of_tip in zip(decrease, cosines, strict=True):
            for cosine in cosines_of_tip:
                exposure += np.where(cosine > lowest, np.polynomial.polynomial.polyval(1 - cosine**2, polynomial), 0.0)
        exposure = exposure.reshape(side, side)
        density = np.divide(counts, exposure, out=np.zeros_like(counts), where=exposure > 1e-3 * exposure.max())
        density /= density[hemisphere].mean()
        for k, (matrix, _) in enumerate(views):
            seen = np.histogram(1 - kept[k][:, 2] ** 2, bins)[0]
            cosine = (grid @ matrix.T[:, 2])[hemisphere.ravel()]
            expected = np.histogram(1 - cosine**2, bins, weights=density[hemisphere])[0]
            ratio = np.divide(seen, expected, out=np.zeros(len(middle)), where=expected > 0)
            polynomial = np.polynomial.polynomial.polyfit(middle, ratio, _DEGREE, w=np.sqrt(expected))
            decrease[k] = polynomial / polynomial[0]
    return sampled(density[None], grid)[0].reshape(side, side)  # beyond the equator that of the opposite direction
