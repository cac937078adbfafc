"""Whether a simulation of the specimen that a reconstruction has found sends its ions where they were seen."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
import scipy

from apt_evap._common.types import Floats
from apt_evap._common.validation import check_count, check_kind, check_number
from apt_evap.evaporation.rule import ConstantPotential
from apt_evap.reconstruction.evolving import EvolvingReconstruction
from apt_evap.simulation.apex import image_compression
from apt_evap.simulation.simulation import Simulation
from apt_evap.specimen.lattice import atom_density
from apt_evap.specimen.materials import Material

SMALL = 6.0
"""Radius of the specimen that is simulated for a check [nm]: potentials and paths depend on the shape only, and a tenth
of the radius takes a thousandth of the ions."""
GATE = 3.0
"""Least gain over its standard error that counts as evidence."""

_WIDTH = math.radians(5.0)  # of the Gaussian of a density on the detector
_BINS = 41
_SECTORS = 12  # left out one after the other for the error
_MORE = 1.1  # ions than of an even flux


@dataclass(frozen=True, eq=False)
class SpecimenCheck:
    """Density of the ions on the detector, beside simulations of the specimen that was found and of its matrix alone.

    Parameters
    ----------
    measured, found, pure : ndarray
        Density over its mean, of each interval of the sequence, shape (k, bins, bins); NaN beyond the field of view.
    explained, error : float
        Part of the density that the phases change in the simulation which is also there in the measurement, and its
        standard error: 1 for the right specimen, 0 for phases that change nothing.
    ions : int
        Ions of the simulations in the field of view.
    """

    measured: Floats = field(repr=False)
    found: Floats = field(repr=False)
    pure: Floats = field(repr=False)
    explained: float
    error: float
    ions: int

    @property
    def is_confirmed(self) -> bool:
        """Whether the simulation with the phases is closer to the measurement than that without, beyond the noise."""
        return self.explained > GATE * self.error

    def __str__(self) -> str:
        what = "confirms" if self.is_confirmed else "does not confirm"
        return (
            f"a simulation of the specimen that was found {what} its phases: {self.explained:.2f} ± {self.error:.2f} "
            f"of what they change on the detector is measured, in {len(self.measured)} intervals"
        )


def check_specimen(
    reconstruction: EvolvingReconstruction,
    material: Material | str | None = None,
    *,
    axis: Sequence[float] = (0, 0, 1),
    radius: float = SMALL,
    intervals: int = 4,
) -> SpecimenCheck:
    r"""Simulate the specimen that was found, and compare the density of its ions with that of the measurement.

    Parameters
    ----------
    reconstruction, material, axis
        As for `EvolvingReconstruction.specimen`.
    radius : float
        Radius of the apex that is simulated [nm]; the ions grow with its cube.
    intervals : int
        Intervals of the sequence.

    Returns
    -------
    SpecimenCheck

    Notes
    -----
    With the densities m of the measurement, f of the simulation, and p of one of the matrix alone, the explained part
    is :math:`\sum (m - p)(f - p) / \sum (f - p)^2`, with the noise of f and p taken off both sums. Its error is by
    sectors of the detector that are left out. The null hypothesis is that the matrix alone explains as much: 0.
    """
    count = check_count(intervals, "intervals", at_least=1, at_most=20)
    size = check_number(radius, "radius", above=0, unit="nm")
    check_kind(reconstruction, "reconstruction", EvolvingReconstruction, "an EvolvingReconstruction")
    tips = [reconstruction.specimen(material, axis=axis, radius=size, phases=phases) for phases in (False, True)]
    sequence = reconstruction.sequence
    places = [sequence.directions[:, :2], *_simulated(tips, sequence)]
    measured, pure, found = (_densities(part, math.sin(sequence.rim), count) for part in places)
    return _compared(measured, found, pure, min(map(len, places[1:])))


def _simulated(tips, sequence):
    """Places x / R and y / R of the simulated ions in the field of view; the first specimen is of the matrix alone."""
    crystal = tips[0].phases[0].material
    # as many ions in the field of view as the cap of the measurement lost, in the scale of the simulation
    volume = len(sequence.directions) * sequence.volume * (tips[0].settings["apex_radius"] / sequence.radius) ** 3
    wanted = int(volume * atom_density(crystal.structure, crystal.a, crystal.c))
    total = int(_MORE * wanted / math.sin(sequence.rim) ** 2)
    compression = None
    for tip in tips:
        simulation = Simulation(tip, seed=1, rule=ConstantPotential())
        run = simulation.run(min(total, len(tip.positions)), responses=False, progress=False)
        run.unless_interrupted()
        if compression is None:
            compression = image_compression(run).compression
        hits = run.hits(run.first_perturbation)
        x, y = hits.x[hits.detected] / run.detector.distance, hits.y[hits.detected] / run.detector.distance
        slopes = np.hypot(x, y)
        inside = np.flatnonzero(compression * np.arctan(slopes) < sequence.rim)[:wanted]
        scale = np.sin(compression * np.arctan(slopes[inside])) / slopes[inside]
        yield np.column_stack([scale * x[inside], scale * y[inside]])


def _densities(places, rim, intervals):
    """Smoothed density over its mean in each interval, shape (k, bins, bins)."""
    edges = np.linspace(-rim, rim, _BINS + 1)
    centres = (edges[1:] + edges[:-1]) / 2
    inside = centres[:, None] ** 2 + centres**2 < (0.95 * rim) ** 2
    width = _WIDTH / (edges[1] - edges[0])
    seen = scipy.ndimage.gaussian_filter((centres[:, None] ** 2 + centres**2 < rim**2).astype(float), width)
    maps = []
    for part in np.array_split(places, intervals):
        counts = scipy.ndimage.gaussian_filter(np.histogram2d(*part.T, bins=(edges, edges))[0], width)
        density = np.where(inside, counts / np.maximum(seen, 0.05), np.nan)
        maps.append(density / np.nanmean(density))
    return np.array(maps)


def _compared(seen, with_phases, alone, ions):
    """Explained part, and its error by sectors that are left out."""
    pattern, change = alone - 1, with_phases - alone
    # least squares of m - 1 over p - 1 and f - p
    products = pattern**2, pattern * change, change**2, (seen - 1) * pattern, (seen - 1) * change
    middle = np.arange(_BINS) - (_BINS - 1) / 2
    sector = ((np.arctan2(middle[:, None], middle) / (2 * math.pi)) % 1.0 * _SECTORS).astype(int) % _SECTORS
    sums = np.array([[np.nansum(part[:, sector == k]) for part in products] for k in range(_SECTORS)])

    def explained(total):
        matrix = np.array([[total[0], total[1]], [total[1], total[2]]])
        return float(np.linalg.lstsq(matrix, total[3:], rcond=1e-6)[0][1])

    whole = sums.sum(axis=0)
    left = np.array([explained(whole - one) for one in sums])
    error = math.sqrt(((left - left.mean()) ** 2).sum() * (_SECTORS - 1) / _SECTORS)
    return SpecimenCheck(seen, with_phases, alone, explained(whole), error, ions)
