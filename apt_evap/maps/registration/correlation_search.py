"""Search for the transform of one map onto another: flattened images, masked correlations, refinement."""

from collections.abc import Iterable
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np
import scipy

from apt_evap._common.types import Booleans, Floats
from apt_evap.detection.binning import field_of_view
from apt_evap.detection.detector_map import DetectorMap
from apt_evap.maps.registration.transform import SimilarityTransform

COARSE, MEDIUM, FINE = 40, 60, 100
"""Pixels across the field of view in the search, in the refinement of its best results, and in the final refinement."""
BROAD = 1 / 8
"""Standard deviation of the Gaussian that flattens maps, in diameters of the field of view."""
NARROW = 0.8
"""Standard deviation of the Gaussian that smooths maps, in pixels."""
RIM = 0.03
"""Width of the excluded rim of the field of view, in its diameters."""
FEWEST = 1000
"""Simulated hits on the measured map below which a registration is not searched: six in each patch of the search."""
ROTATION_STEP, SCALE_STEP = 6.0, 0.1
"""Steps of the search, in rotation [degrees] and in the logarithm of the scale: about two coarse pixels at the rim."""


class Fit(NamedTuple):
    """A transform and the similarity of the images under it."""

    transform: SimilarityTransform
    score: float
    """Correlation coefficient in the common area."""
    overlap: float
    """Fraction of the measured field of view in the common area."""

    @property
    def rank(self) -> float:
        """Quantity that the search maximises: the score times the square root of the overlap."""
        return self.score * np.sqrt(self.overlap)


class ShiftBounds(NamedTuple):
    """Bounds of the shift: the measured position of a simulated point."""

    anchor: complex
    """The simulated point [mm]."""
    place: complex
    """The measured point [mm]."""
    tolerance: float
    """Largest deviation in x and in y [mm]."""


@dataclass(frozen=True, eq=False)
class Image:
    """A flattened map with interpolation; coordinates are complex numbers x + iy [mm]."""

    values: np.ndarray
    mask: np.ndarray
    origin: complex
    bin_size: tuple

    def sample(self, points: Any) -> tuple[Floats, Booleans]:
        """Values at points (0 outside) and whether points are inside, both with the shape of `points`."""
        place = points - self.origin
        index = np.stack([place.imag / self.bin_size[1], place.real / self.bin_size[0]])
        inside = scipy.ndimage.map_coordinates(self.mask, index, order=0, mode="constant") > 0
        return np.where(inside, scipy.ndimage.map_coordinates(self.values, index, order=1, mode="nearest"), 0.0), inside


class View:
    """A map within its field of view, without the rim.

    Parameters
    ----------
    map : DetectorMap
        The map.
    """

    def __init__(self, map: DetectorMap) -> None:
        # densities are scaled to a mean of 20 hits per bin, as field_of_view averages over 20 hits
        values = map.values if map.is_counts else map.values * (20 / map.values[map.mask].mean())
        mask = np.pad(map.mask & field_of_view(np.where(map.mask, values, 0)), 1)
        width, height = map.bin_size
        rim = RIM * 2 * np.sqrt(np.count_nonzero(mask) * width * height / np.pi)
        self.mask = (scipy.ndimage.distance_transform_edt(mask, sampling=(height, width)) > rim)[1:-1, 1:-1]
        self.map = replace(map, mask=self.mask)
        x, y = np.meshgrid(*map.centres)
        points = (x + 1j * y)[self.mask]
        self.centre = complex(points.mean())
        self.diameter = float(2 * np.sqrt(len(points) * width * height / np.pi))
        self.reach = float(np.abs(points - self.centre).max())

    def flatten(self, narrow: float, broad: float) -> Image:
        """Density smoothed by `narrow` divided by that smoothed by `broad` [mm], minus the mean, as an `Image`.

        A tenth of the median density is added to the denominator, and values are clipped at the 1 and 99 percentiles,
        so that neither regions of low density nor single bright spots dominate.
        """
        x_min, x_max, y_min, y_max = self.map.extent
        widest = max(x_max - x_min, y_max - y_min)  # a Gaussian of this width is constant over the map
        fine, wide = (self.map.smoothed(min(sigma, widest)).values for sigma in (narrow, broad))
        ratio = (fine - wide) / (wide + 0.1 * np.median(wide[self.mask]))
        ratio = np.clip(ratio, *np.percentile(ratio[self.mask], [1, 99]))
        values = np.where(self.mask, ratio - ratio[self.mask].mean(), 0.0)
        x, y = self.map.centres
        return Image(values, self.mask.astype(np.uint8), complex(x[0], y[0]), self.map.bin_size)


def correlation(a: Floats, b: Floats) -> float:
    """Correlation coefficient of two arrays, 0 if one is constant (float)."""
    a, b = a - a.mean(), b - b.mean()
    norm = np.sqrt((a @ a) * (b @ b))
    return float(a @ b / norm) if norm > 0 else 0.0


def spectra(values: Any, inside: Any, size: int) -> Any:
    """Fourier transforms of a mask, an image (0 outside the mask) and its square, padded to (size, size)."""
    return scipy.fft.rfft2(np.stack([inside, values, values**2]).astype(np.float32), (size, size))


def correlate(moving: Any, fixed: Any, size: int) -> tuple[Floats, Floats]:
    """Correlation coefficients and numbers of common pixels of two images for all shifts, each of shape (size, size).

    The images are `spectra`; negative shifts of the first image in y and x count from the end. Padfield, IEEE Trans.
    Image Process. 21, 2706 (2012).
    """
    pairs = ((0, 0), (1, 0), (0, 1), (1, 1), (2, 0), (0, 2))
    products = np.stack([np.conj(moving[i]) * fixed[j] for i, j in pairs])
    shared, a, b, ab, aa, bb = scipy.fft.irfft2(products, (size, size))
    shared = np.rint(shared)
    number = np.maximum(shared, 1)
    spread = np.maximum(aa - a * a / number, 0) * np.maximum(bb - b * b / number, 0)
    # a zero spread becomes about 1e-6 of the largest one in float32
    varied = spread > 1e-6 * spread.max()
    return np.where(varied, (ab - a * b / number) / np.sqrt(np.where(varied, spread, 1)), 0), shared


def search(
    simulated: View,
    measured: View,
    rotations: Any,
    scales: Any,
    mirrors: Any,
    least: float,
    shift_bounds: ShiftBounds | None = None,
) -> list[Fit]:
    """Find the best shift for every rotation [degrees], scale and mirror; the best fit first.

    `least` is the smallest common fraction of the measured field of view.
    """
    pixel, broad = measured.diameter / COARSE, BROAD * measured.diameter
    grid = _square(measured.reach, pixel)
    image = measured.flatten(NARROW * pixel, broad)
    # frames at the measured centre that rotate with the simulated map
    frames = [SimilarityTransform(float(rotation), 1.0, place=measured.centre) for rotation in rotations]
    rotated = [image.sample(frame.apply(grid)) for frame in frames]
    fits = []
    for scale in scales:
        image = simulated.flatten(NARROW * pixel / scale, broad / scale)
        points = _square(simulated.reach * scale, pixel)
        size = scipy.fft.next_fast_len(len(points) + len(grid) - 1, real=True)
        # shifts of the simulated centre relative to the measured one, in these frames
        steps = np.arange(size)
        steps = (np.where(steps < len(grid), steps, steps - size) + len(points) // 2 - len(grid) // 2) * pixel
        shifts = steps + 1j * steps[:, None]
        fixed = [spectra(*values, size) for values in rotated]
        for mirror in mirrors:
            unshifted = SimilarityTransform(0.0, float(scale), mirror, simulated.centre)
            moving = spectra(*image.sample(unshifted.apply_inverse(points)), size)
            allowed: Any = True
            for frame, values, (_, inside) in zip(frames, fixed, rotated, strict=True):
                if shift_bounds is not None:
                    target = frame.apply_inverse(shift_bounds.place) - unshifted.apply(shift_bounds.anchor)
                    allowed = np.abs(shifts - target) <= max(shift_bounds.tolerance, pixel)
                score, shared = correlate(moving, values, size)
                overlap = np.minimum(shared / np.count_nonzero(inside), 1)
                best = np.argmax(np.where(allowed & (overlap >= least), score * np.sqrt(overlap), -1))
                if overlap.flat[best] >= least:
                    place = complex(frame.apply(shifts.flat[best]))
                    transform = replace(unshifted, rotation=frame.rotation, place=place)
                    fits.append(Fit(transform, float(score.flat[best]), float(overlap.flat[best])))
    return sorted(fits, key=lambda fit: -fit.rank)


def distinct(fits: Iterable[Fit], n_max: int) -> list[Fit]:
    """The first `n_max` fits that are not close to a better one in rotation and scale."""
    best: list[Fit] = []
    for fit in fits:
        if len(best) == n_max:
            break
        if not any(_close(fit.transform, other.transform) for other in best):
            best.append(fit)
    return best


def hits_on(simulated: View, measured: View, transform: SimilarityTransform) -> float:
    """Number of simulated hits that a transform puts into the measured field of view, of a map of counts (float)."""
    x, y = np.meshgrid(*simulated.map.centres)
    place = transform.apply((x + 1j * y)[simulated.mask])
    left, _, lower, _ = measured.map.extent
    width, height = measured.map.bin_size
    columns, rows = np.floor((place.real - left) / width), np.floor((place.imag - lower) / height)
    inside = (rows >= 0) & (columns >= 0) & (rows < measured.mask.shape[0]) & (columns < measured.mask.shape[1])
    inside[inside] = measured.mask[rows[inside].astype(int), columns[inside].astype(int)]
    return float(simulated.map.values[simulated.mask][inside].sum())


def refine(
    simulated: View,
    measured: View,
    transform: SimilarityTransform,
    pixels: int,
    least: float,
    rotations: tuple[float, ...] | None = None,
    scales: tuple[float, ...] | None = None,
    shift_bounds: ShiftBounds | None = None,
) -> Fit:
    """Maximise the correlation near a transform, with this number of pixels across the measured field of view.

    `least` is its smallest common fraction; equal bounds of rotations or scales fix the value.
    """
    pixel, broad = measured.diameter / pixels, BROAD * measured.diameter
    points = _square(measured.reach, pixel) + measured.centre
    values, inside = measured.flatten(NARROW * pixel, broad).sample(points)
    points, values = points[inside], values[inside]
    image = simulated.flatten(NARROW * pixel / transform.scale, broad / transform.scale)
    # start: about the centre of the measured map, or about the point of the bounds, moved into them
    start = transform.anchored(measured.centre)
    if shift_bounds is not None:
        offset = transform.apply(shift_bounds.anchor) - shift_bounds.place
        offset = complex(*np.clip((offset.real, offset.imag), -shift_bounds.tolerance, shift_bounds.tolerance))
        start = replace(transform, anchor=shift_bounds.anchor, place=shift_bounds.place + offset)
    # unknowns in units of the steps of the search, with their bounds; equal bounds fix an unknown
    free = [rotations is None or rotations[0] < rotations[1], scales is None or scales[0] < scales[1], True, True]
    units = np.array([ROTATION_STEP / 2, SCALE_STEP / 2, pixel, pixel])
    low, high = np.full(4, -np.inf), np.full(4, np.inf)
    if rotations is not None:
        low[0], high[0] = (np.asarray(rotations) - start.rotation) / units[0]
    if scales is not None:
        low[1], high[1] = np.log(np.asarray(scales) / start.scale) / units[1]
    if shift_bounds is not None:
        offset = np.array([offset.real, offset.imag])
        low[2:], high[2:] = (-shift_bounds.tolerance - offset) / pixel, (shift_bounds.tolerance - offset) / pixel

    def moved(steps):
        turn, stretch, x, y = _spread(steps, free) * units
        return replace(
            start,
            rotation=start.rotation + turn,
            scale=start.scale * np.exp(stretch),
            place=start.place + complex(x, y),
        )

    def fit(steps):
        transform = moved(steps)
        values_there, shared = image.sample(transform.apply_inverse(points))
        overlap = np.count_nonzero(shared) / len(points)
        return Fit(transform, correlation(values_there[shared], values[shared]) if overlap >= least else -1.0, overlap)

    low, high = np.minimum(low, 0)[free], np.maximum(high, 0)[free]  # the start is inside, apart from rounding
    # simplex of one step along each unknown, backwards at an upper bound
    simplex = np.vstack([np.zeros(len(low)), np.diag(np.where(high >= 1, 1.0, -1.0))])
    options = {"initial_simplex": np.clip(simplex, low, high), "xatol": 2e-3, "fatol": 1e-6, "maxiter": 400}
    bounds = scipy.optimize.Bounds(low, high)
    result = scipy.optimize.minimize(
        lambda s: -fit(s).rank, simplex[0], method="Nelder-Mead", bounds=bounds, options=options
    )
    return fit(result.x)


def _spread(steps, free):
    whole = np.zeros(4)
    whole[free] = steps
    return whole


def _close(a, b):
    turn = abs((a.rotation - b.rotation + 180) % 360 - 180)
    return (
        a.mirror == b.mirror
        and turn <= 1.5 * ROTATION_STEP
        and abs(np.log(a.scale / b.scale)) <= 1.5 * SCALE_STEP + 1e-9
    )


def _square(reach, pixel):
    """Points of a square grid around 0 that extends to a distance of `reach`, complex of shape (n, n) [mm]."""
    half = int(np.ceil(reach / pixel))
    side = np.arange(-half, half + 1) * pixel
    return side + 1j * side[:, None]
