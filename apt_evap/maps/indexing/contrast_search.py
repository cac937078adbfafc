"""Search of the orientation of a map by its local contrast: by lines and dark poles, as a person sees them.

Map and crystal pass the same filter. The ratio of two means, within 0.035 and 0.12 radii of the field of view, minus
one and between -1 and 1, has neither the slow changes of a map nor the amplitude of one very bright line. The picture y
of a map is then modelled as a sum of terms of the crystal in an orientation,

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

from collections.abc import Sequence

import numpy as np
import scipy

from apt_evap._common.types import Floats
from apt_evap.maps.crystallography.directions import poles, zones
from apt_evap.maps.crystallography.symmetry import point_group
from apt_evap.maps.indexing.master_pattern import HALF, PIXEL, MasterPattern, nearest
from apt_evap.maps.indexing.orientation_search import (
    AZIMUTHS,
    RINGS,
    Disc,
    Start,
    about_axis,
    axes_of,
    misorientation,
    oriented,
    polar_grid,
)
from apt_evap.maps.indexing.refine import directions_of
from apt_evap.specimen.materials import Material

NARROW, WIDE = 0.035, 0.12
"""Standard deviations of the Gaussians of the two means [radii of the field of view]."""
PIECES = 400
"""Independent pieces of a picture: about twice the area of the disc over that of the narrow Gaussian, 4 pi sigma^2."""
PATTERN, LINES, POLES = 0.6, 1.0, 0.8
"""Standard deviations of the priors of the amplitudes, for terms and picture of a variance of 1."""
AXIS_STEP, SCALE_STEP = 2.5, 0.07
"""Steps of the search: of the axes [degrees], and of the logarithm of the scale."""
_FAMILIES = 5  # of poles
_LINE_WIDTH = np.radians(2.0)  # standard deviation: wider than most lines, for the steps of the search
_POLE_RADIUS = 200.0  # lattice constants: the facet of planes d apart is sqrt(2 d / R) wide
_FILTER_STEP = 0.14  # of the logarithm of the half angle, for which the terms are filtered again


def local_contrast(values: Floats, mask: np.ndarray, narrow: Floats, wide: Floats) -> Floats:
    """Ratio of the means of an image in two Gaussians, minus one, between -1 and 1.

    Parameters
    ----------
    values : ndarray
        The image, at least 0.
    mask : ndarray
        Which pixels count.
    narrow, wide : array_like
        Standard deviations along both axes [pixels].

    Returns
    -------
    ndarray
    """
    inside = mask.astype(float)
    fine, slow = (
        scipy.ndimage.gaussian_filter(np.where(mask, values, 0.0), sigma, mode="constant", truncate=3.0)
        / np.maximum(scipy.ndimage.gaussian_filter(inside, sigma, mode="constant", truncate=3.0), 1e-6)
        for sigma in (narrow, wide)
    )
    return np.clip(fine / np.maximum(slow, 1e-6 * max(float(slow.max()), 1e-30)) - 1, -1, 1)


def _places():
    """Points of a polar picture in radii of the disc, (n, 2), and their areas, (n,)."""
    radii, azimuths = polar_grid(RINGS, AZIMUTHS)
    r, phi = (values.ravel() for values in np.meshgrid(radii, azimuths, indexing="ij"))
    return np.column_stack([r * np.cos(phi), r * np.sin(phi)]), r / r.sum()


def picture_of(disc: Disc) -> Floats:
    """Local contrast of a map at the points of a polar picture, with a mean of 0 and a variance of 1, shape (n,)."""
    places, areas = _places()
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
        line = (np.arange(2 * HALF + 1) - HALF) * PIXEL
        x, y = np.meshgrid(line, line)
        stretch = np.sqrt(np.maximum(1 - (x * x + y * y) / 4, 0))
        directions = np.stack([x * stretch, y * stretch, 1 - (x * x + y * y) / 2], axis=-1)
        self._inside = x * x + y * y <= 2
        self._images = [density for pattern in patterns for density in pattern.densities]
        axes = zones(material)
        families = [axes.directions[axes.families == family] for family in range(axes.families.max() + 1)]
        for members in families:
            angles = np.arcsin(np.minimum(np.abs(directions @ members.T).min(axis=-1), 1))
            self._images.append(1 + np.exp(-0.5 * (angles / _LINE_WIDTH) ** 2))
        crystal = poles(material, _FAMILIES)
        spacings = crystal.spacings.round(9)
        for spacing in sorted(set(spacings), reverse=True):
            angles = np.arccos(np.minimum(np.abs(directions @ crystal.normals[spacings == spacing].T).max(axis=-1), 1))
            width = 0.5 * np.sqrt(2 * spacing / (_POLE_RADIUS * material.a))
            self._images.append(1 - np.exp(-0.5 * (angles / width) ** 2))
        counts = 2 * len(patterns), len(families), len(set(spacings))
        self.priors = np.repeat([PATTERN, LINES, POLES], counts)
        """Standard deviations of the amplitudes, shape (k,)."""
        self.signed = np.repeat([False, True, False], counts)
        """Which amplitudes may be negative, shape (k,)."""
        self._cubic = material.structure != "hcp"
        self._filtered: dict[int, Floats] = {}

    def at(self, directions: Floats, half_angle: float) -> Floats:
        """Filtered terms at unit vectors of the crystal.

        Parameters
        ----------
        directions : ndarray
            Shape (m, 3).
        half_angle : float
            Of the field of view [rad]: the filter is relative to it, in steps of 14 %.

        Returns
        -------
        ndarray
            Shape (k, m).
        """
        step = round(float(np.log(half_angle)) / _FILTER_STEP)
        if step not in self._filtered:
            sizes = np.array([NARROW, WIDE]) * np.exp(step * _FILTER_STEP) / PIXEL
            images = [local_contrast(image, self._inside, *sizes) for image in self._images]
            self._filtered[step] = np.stack(images).astype(np.float32)
        if self._cubic:  # the equal direction next to [001], where the pixels are least distorted
            directions = np.sort(np.abs(directions), axis=1)
        return nearest(self._filtered[step], directions)


def evidence(gram: Floats, cross: Floats, priors: Floats, signed: np.ndarray) -> Floats:
    """Evidence E of pictures for the terms of a model, see the module.

    Parameters
    ----------
    gram : ndarray
        Products G of the terms, means over the disc, shape (..., k, k).
    cross : ndarray
        Products of the terms with m pictures of a variance of 1, shape (..., k, m).
    priors : ndarray
        Standard deviations of the amplitudes, shape (k,).
    signed : ndarray
        Which amplitudes may be negative, shape (k,).

    Returns
    -------
    ndarray
        Shape (..., m). Amplitudes of the largest likelihood that may not be negative and are, are set to 0, the others
        are kept: what is explained is then at least this.
    """
    ridge = gram + np.diag(1 / (PIECES * priors**2))
    amplitudes = np.linalg.solve(ridge, cross)
    amplitudes = np.where(signed[:, None], amplitudes, np.maximum(amplitudes, 0))
    explained = (amplitudes * (2 * cross - ridge @ amplitudes)).sum(axis=-2)
    volume = np.linalg.slogdet(np.eye(len(priors)) + PIECES * priors[:, None] * gram * priors)[1]
    return -PIECES * np.log1p(-np.clip(explained, 0, 0.999)) - volume[..., None]


def search_contrast(
    disc: Disc, material: Material, patterns: Sequence[MasterPattern], scales: tuple[float, float], n_max: int
) -> list[Start]:
    """Compare the local contrast of a map with all orientations and scales of a crystal.

    Parameters
    ----------
    disc : Disc
        The map.
    material : Material
        The crystal.
    patterns : sequence of MasterPattern
        Its patterns.
    scales : tuple of float
        Smallest and largest scale [mm/rad].
    n_max : int
        Largest number of orientations.

    Returns
    -------
    list of Start
        The orientations of the largest evidence, each more than two steps from a better one, the best first; for every
        pattern one start, with half of each density.
    """
    places, areas = _places()
    terms = Terms(material, patterns)
    spectrum = np.fft.rfft((picture_of(disc) * areas).reshape(RINGS, AZIMUTHS), axis=1)
    group = point_group(material.structure)
    proper = group[np.linalg.det(group) > 0]
    turns = np.stack([about_axis(axis) for axis in axes_of(material.structure, AXIS_STEP)])
    azimuths = polar_grid(RINGS, AZIMUTHS)[1]
    steps = int(np.ceil(np.log(scales[1] / scales[0]) / SCALE_STEP))
    scored = []
    for scale in np.geomspace(*scales, steps + 1):
        local = directions_of(places, disc.radius, scale, 0.0)
        pictures = terms.at((local @ turns).reshape(-1, 3), disc.radius / scale)
        pictures = pictures.reshape(len(terms.priors), len(turns), -1).swapaxes(0, 1).astype(float)
        pictures -= (pictures @ areas)[..., None]
        pictures /= np.maximum(np.sqrt(pictures**2 @ areas), 1e-3)[..., None]
        gram = (pictures * areas) @ pictures.swapaxes(1, 2)
        spectra = np.fft.rfft(pictures.reshape(*pictures.shape[:2], RINGS, AZIMUTHS), axis=3)
        for mirror in (False, True):
            products = ((spectra if mirror else spectra.conj()) * spectrum).sum(axis=2)
            values = evidence(gram, np.fft.irfft(products, AZIMUTHS, axis=2), terms.priors, terms.signed)
            best = values.argmax(axis=1)
            for turn, column, value in zip(turns, best, values.max(axis=1), strict=True):
                scored.append((value, scale, turn, mirror, azimuths[column]))
    scored.sort(key=lambda entry: -entry[0])
    chosen: list[tuple[Floats, float]] = []
    starts: list[Start] = []
    for value, scale, turn, mirror, angle in scored:
        matrix = oriented(turn, mirror, angle)
        if not any(
            misorientation(matrix, other, proper) < 2 * AXIS_STEP and abs(np.log(scale / size)) < 2.5 * SCALE_STEP
            for other, size in chosen
        ):
            chosen.append((matrix, scale))
            starts += [Start(matrix, float(scale), float(value), 0.5, number) for number in range(len(patterns))]
            if len(chosen) == n_max:
                break
    return starts
