"""Whether the densities of a simulated pattern are those of a measured map: three gains that can be negative.

Maps with a dark pole and lines resemble each other, whatever the crystal, so a correlation alone says little. The
pattern is compared with what could be as good: lines that are drawn along the zones of the crystal, with free
amplitudes; the pattern turned about the pole; and other crystals. All see only what changes along the azimuth about a
pole: density over its mean within 6 degrees, without the mean of each ring. The amplitudes of each are fitted on two
thirds of the sectors, and scored on the last third.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import scipy

from apt_evap._common.types import Floats
from apt_evap._common.validation import check_kind, check_number, check_seed, check_sequence
from apt_evap.detection.detector_map import DetectorMap
from apt_evap.detection.projection import Projection
from apt_evap.maps.crystallography.directions import zones
from apt_evap.maps.crystallography.orientation import Orientation
from apt_evap.maps.pole_frame import pole_frame

Densities = Callable[[Floats], Floats]
"""Densities of shape (k, n) in the directions of the specimen (n, 3); of several their sum is fitted."""
EXCEEDS = 3.0
"""Gain in errors from which on a pattern is better."""
NARROW, BROAD = 0.6, 6.0
"""Smoothing of the densities, and of the mean by which they are divided [degrees]."""
SECTORS, RINGS = 18, 6.0
"""Sectors about the pole, and the width of the rings that with them are the blocks of the bootstrap [degrees]."""
_LINES = (1.0, 2.5)  # standard deviations of drawn lines [degrees]
_TURNS = {"3": 60.0, "2": 90.0, "4": 45.0, "6": 30.0}  # degrees, by the order of the symmetry of the pole
_FOLDS, _RESAMPLES, _LEAST_POINTS = 3, 400, 300


@dataclass(frozen=True)
class DensityGains:
    """How well a pattern reproduces the densities about a pole; result of `density_gains`.

    Parameters
    ----------
    correlation : float
        Of the pattern and the map, on the sectors that its amplitudes were not fitted on.
    over_lines, over_turned, over_others : float
        Its difference to that of the drawn lines, of the turned pattern and of the best other crystal, in errors; NaN
        for other crystals if none was given.
    """

    correlation: float
    over_lines: float
    over_turned: float
    over_others: float

    @property
    def level(self) -> str:
        """The level that the gains reach: "alike", "same orientation", "orientation about the pole", or "none"."""
        if not self.over_turned > EXCEEDS:
            return "none"
        if not self.over_others > EXCEEDS:
            return "orientation about the pole"
        return "alike" if self.over_lines > EXCEEDS else "same orientation"

    def __str__(self):
        sentence = {
            "alike": "alike: drawn lines, the turned pattern and other crystals reproduce the densities less well",
            "same orientation": "same crystal and orientation; densities are not reproduced better than by drawn lines",
            "orientation about the pole": "the orientation about the pole; other crystals are not excluded",
            "none": "not even the orientation about the pole: the turned pattern is about as good",
        }[self.level]
        others = "no other crystal was tried" if np.isnan(self.over_others) else f"{self.over_others:+.1f} over others"
        return (
            f"{sentence} (gains in standard errors: {self.over_lines:+.1f} over lines, {self.over_turned:+.1f} over "
            f"the turned pattern, {others}; each must be above {EXCEEDS:g})"
        )


def density_gains(
    map: DetectorMap,
    orientation: Orientation,
    projection: Projection,
    pattern: Densities,
    plane: Sequence[int],
    *,
    others: Sequence[Densities] = (),
    reach: float = 20.0,
    seed: int = 0,
) -> DensityGains:
    """Compare the densities of a map about a pole with those of a pattern, and with what could be as good.

    Parameters
    ----------
    map : DetectorMap
        Measured counts or densities.
    orientation : Orientation
        Orientation of the crystal, such as that of a `Candidate`.
    projection : Projection
        Where directions are on the map.
    pattern : callable
        Densities of shape (k, n) in the directions of the specimen (n, 3).
    plane : sequence of int
        Miller indices of a family of planes; of its poles the one nearest to the axis.
    others : sequence of callable
        The same of other crystals in their best orientation.
    reach : float
        Largest angle from the pole [degrees].
    seed : int
        Seed of the bootstrap.

    Returns
    -------
    DensityGains

    Raises
    ------
    ValueError
        If the pole has no rotational symmetry, or too little of the map is within the reach.
    """
    check_kind(map, "map", DetectorMap, "a DetectorMap")
    check_kind(orientation, "orientation", Orientation, "an Orientation")
    check_kind(projection, "projection", Projection, "a Projection")
    reach = check_number(reach, "reach", at_least=5, at_most=60, unit="degrees")
    others = check_sequence(others, "others", "callables")
    pole, symmetry, _ = orientation.nearest_pole(plane)
    if symmetry[0] not in _TURNS:
        raise ValueError(f"plane must have a rotational symmetry of 2 to 6, got {plane} with {symmetry}")
    frame = pole_frame(map, projection, pole, np.inf)
    near = frame.angle < reach
    azimuth, angle = frame.azimuth[near], frame.angle[near]
    if np.count_nonzero(near) < _LEAST_POINTS:
        raise ValueError(
            f"map must have at least {_LEAST_POINTS} bins within {reach:g} degrees of the pole, got {near.sum()}"
        )
    degree = np.radians(1.0) * projection.scale
    rings = np.floor(angle).astype(int)

    def azimuthal(values):
        """Flattened density of the bins, without the mean of every ring."""
        image = np.full(map.values.shape, np.nan)
        image[map.mask] = values
        whole = DetectorMap.from_array(image, map.x_edges, map.y_edges, map.mask)
        fine, broad = (whole.smoothed(sigma * degree).values[map.mask][near] for sigma in (NARROW, BROAD))
        flat = fine / np.maximum(broad, 1e-9 * max(broad.max(), 1e-30)) - 1
        number = np.bincount(rings)
        return flat - (np.bincount(rings, flat) / np.maximum(number, 1))[rings]

    sectors = np.minimum((azimuth * SECTORS).astype(int), SECTORS - 1)
    seen = azimuthal(frame.hits / frame.solid)

    def predicted(densities, directions, signed=False):
        """What densities predict on sectors that their amplitudes were not fitted on."""
        parts = np.array([azimuthal(part) for part in np.atleast_2d(densities(directions))]).T
        result = np.zeros(len(seen))
        for fold in range(_FOLDS):
            scored = sectors % _FOLDS == fold
            if signed:
                amplitudes = np.linalg.lstsq(parts[~scored], seen[~scored], rcond=None)[0]
            else:
                amplitudes = scipy.optimize.nnls(parts[~scored], seen[~scored])[0]
            result[scored] = parts[scored] @ amplitudes
        return result

    axes = zones(orientation.material)

    def lines(directions):
        crystal = directions @ orientation.matrix
        drawn = []
        for family in range(axes.families.max() + 1):
            distance = np.degrees(np.arcsin(np.abs(crystal @ axes.directions[axes.families == family].T).min(axis=1)))
            drawn += [1 + np.exp(-0.5 * (distance / width) ** 2) for width in _LINES]
        return np.array(drawn)

    turn = scipy.spatial.transform.Rotation.from_rotvec(_TURNS[symmetry[0]] * pole, degrees=True).as_matrix()
    models = [
        predicted(pattern, frame.directions),
        predicted(lines, frame.directions, signed=True),
        predicted(pattern, frame.directions @ turn),
        *(predicted(other, frame.directions) for other in others),
    ]
    # correlations of resampled blocks
    blocks = np.unique(sectors * 100 + (angle // RINGS).astype(int), return_inverse=True)[1]
    sums = np.array(
        [[np.bincount(blocks, weights) for weights in (seen * model, model**2, seen**2)] for model in models]
    )
    number = sums.shape[2]
    times = np.random.default_rng(check_seed(seed)).multinomial(number, np.full(number, 1 / number), _RESAMPLES)

    def correlations(weights):
        products, model, map = (sums @ weights.T).swapaxes(0, 1)
        return products / np.sqrt(np.maximum(model * map, 1e-30))

    values, resampled = correlations(np.ones((1, number)))[:, 0], correlations(times)
    gains = [
        (values[0] - value) / max((resampled[0] - other).std(ddof=1), 1e-9)
        for value, other in zip(values[1:], resampled[1:], strict=True)
    ]
    return DensityGains(float(values[0]), gains[0], gains[1], min(gains[2:], default=float("nan")))
