"""Search of the orientation of a map by its local contrast: by lines and dark poles, as a person sees them.

Map and crystal pass the same filter. The ratio of two means, within 0.035 and 0.12 radii of the field of view, minus
one and between -1 and 1, has no slow changes. Divided by its local standard deviation it has no areas of strong and of
weak structure, either: one very bright line does not decide. The picture y of a map is then modelled as a sum of terms
of the crystal in an orientation,

    y = sum_k a_k t_k + noise,

with the master patterns of all radii (a_k >= 0), one term for all zone lines of a family, which may be bright or dark,
and one for the dark poles of a family (a_k >= 0). Patterns alone miss maps whose lines have another width or sign than
the simulated ones; lines alone miss maps whose lines are beside their zones.

The amplitudes have Gaussian priors of zero mean and standard deviations s_k, and the variance of the noise is unknown.
Orientations and scales are compared by twice the logarithm of their marginal likelihood, up to a constant,

    E = -N ln(1 - r^2) - ln det(1 + N S G S),

with the products G of the terms, S = diag(s_k), the number N of independent pieces of the picture, and the part r^2 of
the variance of y that is explained. The second part is why terms that are different in an orientation, and so can fit
more, are not better by themselves.
"""

import math
from collections.abc import Sequence
from functools import lru_cache
from typing import NamedTuple

import numpy as np
import scipy

from apt_evap._common.types import Floats
from apt_evap.maps.crystallography.directions import poles, zones
from apt_evap.maps.indexing.master_pattern import HALF, PIXEL, MasterPattern, master_patterns, nearest_pixels, sampled
from apt_evap.maps.indexing.orientation_search import AZIMUTHS, RINGS, Disc, Start, polar_grid
from apt_evap.maps.indexing.refine import LARGEST_STRETCH, STRETCH, directions_of, rotation_of
from apt_evap.specimen.materials import Material, as_material

NARROW, WIDE = 0.035, 0.12
"""Standard deviations of the Gaussians of the two means [radii of the field of view]."""
PIECES = 400
"""Independent pieces of a picture: about twice the area of the disc over that of the narrow Gaussian, 4 pi sigma^2."""
PATTERN, LINES, POLES = 0.6, 1.0, 0.8
"""Standard deviations of the priors of the amplitudes, for terms and picture of a variance of 1."""
_TYPICAL = {"fcc": "Ni", "bcc": "W", "diamond": "Si"}
_FLOOR = 0.5  # of the median of the local standard deviation: smaller ones are set to this
_TANGENT, _SINE = math.sqrt(1 / 3), math.sqrt(3 / 4)  # of 30 and of 60 degrees
_FLAT = 1e-6  # contrast of an image that has none
_FAMILIES = 5  # of poles
_LINE_WIDTH = np.radians(2.0)  # standard deviation: wider than most lines, for the steps of the search
_POLE_RADIUS = 200.0  # lattice constants: the facet of planes d apart is sqrt(2 d / R) wide
_STEPS, _FINE = 8, 0.02  # steps of a refinement at most; change of the evidence that ends it
_DIFFERENCE = 4e-3  # [rad] of the numerical derivatives
_FILTER_STEP = 0.14  # of the logarithm of the half angle, for which the terms are filtered again


def local_contrast(
    values: np.ndarray,
    mask: np.ndarray,
    narrow: Floats,
    wide: Floats,
    used: np.ndarray | None = None,
    inner: tuple[slice, ...] | None = None,
) -> np.ndarray:
    """Contrast of images (..., ny, nx) of values from 0 in units of their local standard deviation.

    The ratio of the means in a narrow and a wide Gaussian (standard deviations along both axes [pixels]), minus one,
    between -1 and 1, is divided by the square root of its mean square in the wide one, which is at least half its
    median over the pixels `used`, by default those of the mask. Only rows and columns `inner` are computed.
    """
    inner = tuple(slice(0, size) for size in mask.shape) if inner is None else inner
    # what the mean square needs
    outer = tuple(
        slice(max(0, part.start - reach), part.stop + reach)
        for part, reach in zip(inner, np.broadcast_to(_reach(wide), 2).tolist(), strict=True)
    )
    within = tuple(slice(part.start - r.start, part.stop - r.start) for part, r in zip(inner, outer, strict=True))
    fine, slow = (_mean(values, mask, sigma, outer) for sigma in (narrow, wide))
    least = 1e-6 * np.maximum(slow.max(axis=(-2, -1), keepdims=True), 1e-30)
    contrast = np.clip(fine / np.maximum(slow, least) - 1, -1, 1)
    deviation = np.sqrt(np.maximum(_mean(contrast**2, mask[outer], wide, within), 0))
    floor = _FLOOR * np.median(deviation[..., (mask if used is None else used)[inner]], axis=-1)[..., None, None]
    return contrast[..., *within] / np.maximum(deviation, np.maximum(floor, _FLAT))


def _mean(values, mask, sigma, part=(slice(None), slice(None))):
    """Mean of the pixels that count in a Gaussian of these standard deviations, in rows and columns of a part."""
    along = [float(width) for width in np.broadcast_to(sigma, 2)]
    values = np.where(mask, values, values.dtype.type(0)).astype(np.result_type(values, np.float32), copy=False)
    rows, columns = (
        _gaussian(size, width, values.dtype)[near] for size, width, near in zip(mask.shape, along, part, strict=True)
    )
    return (rows @ values @ columns.T) / np.maximum(rows @ mask.astype(values.dtype) @ columns.T, 1e-6)


def _reach(sigma):
    """Pixels to which a Gaussian of a standard deviation reaches."""
    return np.asarray(3 * sigma + 0.5).astype(int)


@lru_cache(maxsize=64)
def _gaussian(size, sigma, dtype):
    """Weights of a Gaussian filter of three standard deviations [pixels] along an axis, shape (size, size)."""
    reach = int(_reach(sigma))
    weights = np.exp(-0.5 * (np.arange(-reach, reach + 1) / sigma) ** 2)
    weights /= weights.sum()
    apart = np.abs(np.subtract.outer(np.arange(size), np.arange(size)))
    return np.where(apart <= reach, weights[np.minimum(apart, reach) + reach], 0.0).astype(dtype)


@lru_cache(maxsize=1)
def places_of() -> tuple[Floats, Floats]:
    """Points of a polar picture in radii of the disc, (n, 2), and their areas, (n,); read-only."""
    radii, azimuths = polar_grid(RINGS, AZIMUTHS)
    r, phi = (values.ravel() for values in np.meshgrid(radii, azimuths, indexing="ij"))
    places, areas = np.column_stack([r * np.cos(phi), r * np.sin(phi)]), r / r.sum()
    places.flags.writeable = areas.flags.writeable = False
    return places, areas


def picture_of(disc: Disc) -> Floats:
    """Local contrast of a map at the points of a polar picture, with a mean of 0 and a variance of 1, shape (n,)."""
    places, areas = places_of()
    sizes = np.array(disc.map.bin_size[::-1])
    image = local_contrast(disc.map.values, disc.map.mask, NARROW * disc.radius / sizes, WIDE * disc.radius / sizes)
    x, y = disc.map.centres
    at = (places[:, ::-1] * disc.radius + np.array(disc.centre[::-1]) - (y[0], x[0])) / sizes
    picture = scipy.ndimage.map_coordinates(image, at.T, order=1, mode="nearest")
    picture -= areas @ picture
    return picture / max(float(np.sqrt(areas @ picture**2)), 1e-12)


class Terms:
    """Terms of the model on the hemisphere of a crystal.

    Parameters
    ----------
    material : Material
        The crystal.
    patterns : sequence of MasterPattern
        Its patterns.
    """

    def __init__(self, material: Material, patterns: Sequence[MasterPattern]) -> None:
        # a quarter of the disc: the others are its mirror images
        line = np.arange(HALF + 1) * PIXEL
        x, y = np.meshgrid(line, line)
        stretch = np.sqrt(np.maximum(1 - (x * x + y * y) / 4, 0))
        directions = np.stack([x * stretch, y * stretch, 1 - (x * x + y * y) / 2], axis=-1)
        inside = x * x + y * y <= 2
        images = []
        axes = zones(material)
        families = [axes.directions[axes.families == family] for family in range(axes.families.max() + 1)]
        for members in families:
            angles = np.arcsin(np.minimum(np.abs(directions @ members.T).min(axis=-1), 1))
            images.append(1 + np.exp(-0.5 * (angles / _LINE_WIDTH) ** 2))
        crystal = poles(material, _FAMILIES)
        spacings = crystal.spacings.round(9)
        for spacing in sorted(set(spacings), reverse=True):
            angles = np.arccos(np.minimum(np.abs(directions @ crystal.normals[spacings == spacing].T).max(axis=-1), 1))
            width = 0.5 * np.sqrt(2 * spacing / (_POLE_RADIUS * material.a))
            images.append(1 - np.exp(-0.5 * (angles / width) ** 2))
        others = [(0, 0), (HALF, 0), (HALF, 0)]
        drawn = np.pad(np.stack(images).astype(np.float32), others, mode="reflect")
        self._images = np.concatenate([*(pattern.densities for pattern in patterns), drawn], dtype=np.float32)
        self._inside = np.pad(inside, others[1:], mode="reflect")
        counts = 2 * len(patterns), len(families), len(set(spacings))
        self.priors = np.repeat([PATTERN, LINES, POLES], counts)
        """Standard deviations of the amplitudes, shape (k,)."""
        self.signed = np.repeat([False, True, False], counts)
        """Which amplitudes may be negative, shape (k,)."""
        self.structure = material.structure
        """Crystal structure."""
        # those of one triangle, see `equal`
        if self.structure == "hcp":
            used = inside & (y <= x * _TANGENT)
        else:
            used = (np.diff(directions, axis=-1) >= 0).all(axis=-1)
        self._used = np.pad(used, others[1:])
        # what is used, with the pixels beside it
        self._rows, self._columns = (
            slice(max(0, int(lines[0]) - 1), int(lines[-1]) + 2)
            for lines in (np.flatnonzero(self._used.any(axis=axis)) for axis in (1, 0))
        )
        self.corner = self._rows.start, self._columns.start
        """First row and column of the filtered terms on the disc of a `MasterPattern`."""
        self._filtered: dict[int, np.ndarray] = {}

    def at(self, directions: Floats, half_angle: float) -> tuple[np.ndarray, np.ndarray]:
        """Filtered terms next to unit vectors of the crystal, shape (k, m), and the pixels of these.

        Parameters
        ----------
        directions : ndarray
            Shape (m, 3).
        half_angle : float
            Of the field of view [rad]: the filter is relative to it, in steps of 14 %.

        Returns
        -------
        tuple of ndarray
            The terms, and rows and columns on the disc of a `MasterPattern`, shape (2, m).
        """
        row, column = nearest_pixels(self.equal(directions))
        images = self.images(half_angle)
        flat = images.reshape(len(images), -1)
        pixels = (row - self.corner[0]) * images.shape[2] + column - self.corner[1]
        return flat.take(pixels, axis=1), np.stack([row, column])

    def equal(self, directions: Floats) -> Floats:
        """Equal directions; of cubic crystals those next to [001], where the pixels are least distorted."""
        x, y, z = np.abs(directions).T
        if self.structure == "hcp":  # an azimuth of 0 to 30 degrees: mirrored at 30 degrees, then at 0
            beyond = y > x * _TANGENT
            first, second = x / 2 + _SINE * y, np.abs(_SINE * x - y / 2)
            return np.stack([np.where(beyond, first, x), np.where(beyond, second, y), z], axis=1)
        low, high = np.minimum(x, y), np.maximum(x, y)
        return np.stack([np.minimum(low, z), np.maximum(low, np.minimum(high, z)), np.maximum(high, z)], axis=1)

    def images(self, half_angle: float) -> np.ndarray:
        """Filtered terms for a field of view of this half angle [rad], from the pixel `corner` on, shape (k, n, m)."""
        step = round(float(np.log(half_angle)) / _FILTER_STEP)
        if step not in self._filtered:
            sizes = np.array([NARROW, WIDE]) * np.exp(step * _FILTER_STEP) / PIXEL
            margin = 2 * int(_reach(sizes[1]))
            near = tuple(slice(max(0, part.start - margin), part.stop + margin) for part in (self._rows, self._columns))
            inner = tuple(
                slice(part.start - whole.start, part.stop - whole.start)
                for part, whole in zip((self._rows, self._columns), near, strict=True)
            )
            part = self._images[:, *near], self._inside[near], *sizes, self._used[near], inner
            self._filtered[step] = np.ascontiguousarray(local_contrast(*part), np.float32)
        return self._filtered[step]


@lru_cache(maxsize=8)
def terms_of(material: Material) -> Terms:
    """Terms of a crystal with the patterns of the package; all cubic crystals of a structure have the same."""
    if material.structure in _TYPICAL and material != (typical := as_material(_TYPICAL[material.structure])):
        return terms_of(typical)
    return Terms(material, master_patterns(material.structure))


def evidence(gram: Floats, cross: Floats, priors: Floats, signed: np.ndarray, pieces: float = PIECES) -> Floats:
    """Evidence E of m pictures for k terms of a model, shape (..., m), see the module.

    `gram` has the products G of the terms, means over the disc, (..., k, k), `cross` those with pictures of a variance
    of 1, (..., k, m), `priors` the standard deviations of the amplitudes. Amplitudes of the largest likelihood that may
    not be negative (`signed`) and are, are set to 0, the others are kept: what is explained is then at least this.
    """
    ridge = gram + np.diag(1 / (pieces * priors**2))
    amplitudes = np.linalg.solve(ridge, cross)
    amplitudes = np.where(signed[:, None], amplitudes, np.maximum(amplitudes, 0))
    return _evidence(ridge, cross, priors, amplitudes, pieces)


def exact_evidence(gram: Floats, cross: Floats, priors: Floats, signed: np.ndarray) -> tuple[float, Floats]:
    """Evidence E of one picture with the best amplitudes, and these, shape (k,); parameters as of `evidence`."""
    ridge = gram + np.diag(1 / (PIECES * priors**2))
    root = np.linalg.cholesky(ridge).T
    # an amplitude of either sign is the difference of two that are not negative
    parts = scipy.optimize.nnls(np.hstack([root, -root[:, signed]]), np.linalg.solve(root.T, cross))[0]
    amplitudes = parts[: len(priors)]
    amplitudes[signed] -= parts[len(priors) :]
    return float(_evidence(ridge, cross[:, None], priors, amplitudes[:, None])[0]), amplitudes


def _evidence(ridge, cross, priors, amplitudes, pieces=PIECES):
    explained = (amplitudes * (2 * cross - ridge @ amplitudes)).sum(axis=-2)
    volume = np.linalg.slogdet(pieces * priors[:, None] * ridge * priors)[1]  # of 1 + N S G S
    return -pieces * np.log1p(-np.clip(explained, 0, 0.999)) - volume[..., None]


class Explained(NamedTuple):
    """An orientation at a maximum of the evidence."""

    matrix: np.ndarray
    """Rotation from crystal to specimen, shape (3, 3)."""
    scale: float
    """[mm/rad], from the centre to the rim of the disc."""
    stretch: float
    """Radial stretch, as in `refine`."""
    evidence: float
    """E of the module, with a prior of the stretch."""


def refine_contrast(
    picture: Floats, radius: float, terms: Terms, start: Start, bounds: tuple[float, float]
) -> Explained:
    """Maximise the evidence near a start by Gauss-Newton steps; the amplitudes follow.

    The radius is that of the field of view [mm], the bounds are those of the scale [mm/rad].
    """
    places, areas = places_of()
    places = places.astype(np.float32)
    limits = np.log(bounds)
    local: dict[tuple[float, float], Floats] = {}

    def directions(geometry):
        key = float(geometry[3]), float(geometry[4])
        if key not in local:  # rotations do not change them
            local.clear()
            local[key] = directions_of(places, radius, math.exp(key[0]), key[1])
        return local[key] @ (rotation_of(geometry[:3]) @ start.matrix).astype(np.float32)

    def sample(images, *geometries):
        """Pictures of one image for several geometries, or of several images for one."""
        at = np.concatenate([directions(geometry) for geometry in geometries])
        pictures = sampled(images, terms.equal(at), terms.corner).astype(float).reshape(-1, len(places))
        return pictures - (pictures @ areas)[:, None]

    def judged(geometry):
        images = terms.images(radius / math.exp(geometry[3]))
        pictures = sample(images, geometry)
        norms = np.maximum(np.sqrt(pictures**2 @ areas), 1e-3)
        pictures /= norms[:, None]
        gram, cross = (pictures * areas) @ pictures.T, (pictures * areas) @ picture
        value, amplitudes = exact_evidence(gram, cross, terms.priors, terms.signed)
        return value - (geometry[4] / STRETCH) ** 2, amplitudes / norms, amplitudes @ pictures

    geometry = np.array([0.0, 0.0, 0.0, np.clip(math.log(start.scale), *limits), 0.0])
    value, amplitudes, model = judged(geometry)
    for _ in range(_STEPS):
        image = np.tensordot(amplitudes.astype(np.float32), terms.images(radius / math.exp(geometry[3])), 1)[None]
        here, *moved_by = sample(image, geometry, *(geometry + _DIFFERENCE * np.eye(5)))
        slopes = (np.stack(moved_by) - here) / _DIFFERENCE
        left = picture - model
        prior = np.array([0, 0, 0, 0, max(areas @ left**2, 1e-3) / (PIECES * STRETCH**2)])
        normal = (slopes * areas) @ slopes.T
        right = (slopes * areas) @ left - prior * geometry
        step = np.linalg.solve(normal + np.diag(prior + 1e-2 * np.diag(normal) + 1e-9), right)
        step = np.clip(step, -0.05, 0.05)
        for _ in range(3):
            moved = geometry + step
            moved[3:] = np.clip(moved[3], *limits), np.clip(moved[4], -LARGEST_STRETCH, LARGEST_STRETCH)
            new = judged(moved)
            if new[0] > value:
                break
            step = step / 3
        if new[0] <= value + _FINE:
            break
        geometry, (value, amplitudes, model) = moved, new
    return Explained(rotation_of(geometry[:3]) @ start.matrix, math.exp(geometry[3]), float(geometry[4]), value)
