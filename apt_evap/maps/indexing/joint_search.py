"""Search of the orientation of a map: its counts and its local contrast against a crystal, on one grid.

All axes, rotations and scales are compared by two criteria: the evidence of the local contrast (`contrast_search`), and
the correlation of the flattened picture of the counts with the master patterns, whose two amplitudes are fitted and not
negative. Pictures are polar, so that all rotations about an axis are one Fourier transform along the azimuth.

What the crystal gives is kept, so a surrogate of the map, whose azimuthal harmonics have other phases, costs no new
pictures: the phases multiply the products of the spectra.
"""

from collections.abc import Sequence
from functools import lru_cache
from typing import NamedTuple

import numpy as np
import scipy

from apt_evap._common.types import Floats
from apt_evap.detection.projection import Projection
from apt_evap.maps.indexing.contrast_search import PIECES, Terms, places_of
from apt_evap.maps.indexing.marked_poles import Mark, rotations_misfit
from apt_evap.maps.indexing.master_pattern import HALF, MasterPattern
from apt_evap.maps.indexing.orientation_search import (
    AZIMUTHS,
    BRIGHTEST,
    RINGS,
    SMOOTHED,
    Disc,
    Start,
    about_axis,
    axes_of,
    distinct_starts,
    flattened,
    oriented,
    polar_grid,
    slow_of_pictures,
)
from apt_evap.maps.indexing.refine import directions_of
from apt_evap.specimen.symmetry import point_group

AXIS_STEP, SCALE_STEP = 3.5, 0.10
"""Steps of the search: of the axes [degrees], and of the logarithm of the scale."""
COUNTS = 100.0
"""Independent pieces of the flattened picture of the counts: a correlation r is worth -COUNTS ln(1 - r^2)."""
CONTRAST, COUNTED, JOINT = range(3)
"""Which of the criteria: the evidence of the contrast, that of the counts, or their sum."""
_AT_ONCE = 24  # axes whose pictures are made together
_SORTED = 400  # best points of the grid among which different starts are searched


class _Slice(NamedTuple):
    """Products of the map with a crystal at one scale and one handedness, for all axes."""

    scale: float
    mirror: bool
    contrast: np.ndarray
    """Spectra along the azimuth of the products of the terms with the contrast of the map, shape (axes, k, f)."""
    ridge: np.ndarray
    inverse: np.ndarray
    """Products of the terms with the prior, and their inverse, shape (axes, k, k)."""
    volume: np.ndarray
    """Of the evidence, shape (axes,)."""
    counts: np.ndarray
    """Spectra of the products of the patterns with the flattened counts, shape (axes, patterns, 2, f)."""
    norms: np.ndarray
    """Squares of the norms of the patterns, shape (axes, patterns, 2)."""
    inverse_counts: np.ndarray
    """Inverse products of the two densities of a pattern, shape (axes, patterns, 2, 2)."""


class JointSearch:
    """Comparison of a map with all orientations and scales of a crystal.

    Parameters
    ----------
    disc : Disc
        The map, flattened by rings.
    picture : ndarray
        Its local contrast, of `picture_of`.
    terms : Terms
        Those of the local contrast of the crystal.
    patterns : sequence of MasterPattern
        Its patterns.
    scales : tuple of float
        Smallest and largest scale [mm/rad].
    marks : sequence of Mark
        Marks of a user.
    """

    def __init__(
        self,
        disc: Disc,
        picture: Floats,
        terms: Terms,
        patterns: Sequence[MasterPattern],
        scales: tuple[float, float],
        marks: Sequence[Mark] = (),
    ) -> None:
        group = point_group(terms.structure)
        self._proper = group[np.linalg.det(group) > 0]
        # of an axis and its mirror image the pattern is the same, with the azimuth reversed
        self._turns = np.stack([about_axis(axis) for axis in axes_of(terms.structure, AXIS_STEP)])
        self._terms, self._patterns = terms, [smoothed_pattern(pattern) for pattern in patterns]
        contrast = scipy.fft.rfft(picture.astype(np.float32).reshape(RINGS, AZIMUTHS), axis=1)
        steps = int(np.ceil(np.log(scales[1] / scales[0]) / SCALE_STEP))
        self._slices: list[_Slice] = []
        costs = []
        for scale in np.geomspace(*scales, steps + 1):
            self._slices += self._at_scale(disc, contrast, float(scale))
            costs += _costs(disc, marks, self._turns, float(scale))
        self._costs = np.array(costs)
        self._own: tuple | None = None

    def _at_scale(self, disc, contrast, scale):
        """Products of the map with the crystal at a scale, for both hands."""
        counts, n = _spectrum_of_counts(disc, scale), len(self._turns)
        # what a few axes need stays in the cache of a processor
        parts = [
            self._of_axes(self._turns[first : first + _AT_ONCE], disc.radius, scale, contrast, counts)
            for first in range(0, n, _AT_ONCE)
        ]
        joined = (np.concatenate(part) for part in zip(*parts, strict=True))
        both, both_counts, ridge, volume, norms, inverse_counts = joined
        single = [values.astype(np.float32) for values in (ridge, np.linalg.inv(ridge), volume)]
        for k, mirror in enumerate((False, True)):
            yield _Slice(
                scale, mirror, both[:, k], *single, both_counts[:, k], norms.astype(np.float32),
                inverse_counts.astype(np.float32),
            )  # fmt: skip

    def _of_axes(self, turns, radius, scale, contrast, counts):
        """The parts of a `_Slice` of some axes, for both hands along the second axis of the spectra."""
        terms, n = self._terms, len(turns)
        places, areas = places_of()
        areas = areas.astype(np.float32)
        directions = directions_of(places.astype(np.float32), radius, scale, 0.0) @ turns.astype(np.float32)
        pictures, (row, column) = terms.at(directions.reshape(-1, 3), radius / scale)
        pictures = pictures.reshape(len(pictures), n, -1).swapaxes(0, 1)
        # means and norms are taken off the products, as the map has a mean of 0
        weighted, means = pictures * areas, pictures @ areas
        gram = weighted @ pictures.swapaxes(1, 2) - means[..., None] * means[:, None]
        norms_of_terms = np.maximum(np.sqrt(np.maximum(np.einsum("nkk->nk", gram), 0)), 1e-3)
        gram /= norms_of_terms[..., None] * norms_of_terms[:, None]
        ridge = gram.astype(float) + np.diag(1 / (PIECES * terms.priors**2))
        volume = np.linalg.slogdet(PIECES * terms.priors[:, None] * ridge * terms.priors)[1]
        spectra = scipy.fft.rfft(weighted.reshape(n, -1, RINGS, AZIMUTHS), axis=3)
        of_contrast = _products(spectra, contrast) / norms_of_terms[:, None, :, None]
        slow, weights = slow_of_pictures()
        slow, root = slow.astype(np.float32), np.sqrt(weights).astype(np.float32)
        pixels = row * (2 * HALF + 1) + column
        densities = np.concatenate([pattern.reshape(2, -1).take(pixels, axis=1) for pattern in self._patterns])
        densities = np.minimum(densities, BRIGHTEST).reshape(-1, n, RINGS * AZIMUTHS).swapaxes(0, 1) * root
        # slow changes are taken off the products, as the flattened map has none
        changes = (densities @ slow).reshape(n, len(self._patterns), 2, -1)
        densities = densities.reshape(n, len(self._patterns), 2, -1)
        products = (densities @ densities.swapaxes(2, 3) - changes @ changes.swapaxes(2, 3)).astype(float)
        norms = np.maximum(np.einsum("npkk->npk", products), 1e-30)
        inverse_counts = np.linalg.inv(products + 1e-6 * norms.sum(axis=2)[..., None, None] * np.eye(2))
        of_counts = scipy.fft.rfft(densities.reshape(*densities.shape[:3], RINGS, AZIMUTHS), axis=4)
        return of_contrast, _products(of_counts, counts), ridge, volume, norms, inverse_counts

    def _values(self, phases):
        """Both criteria without marks, shape (2, slices, axes, azimuths), with these factors of the harmonics."""
        contrast, counted = [], []
        for part in self._slices:
            cross = scipy.fft.irfft(part.contrast * phases, AZIMUTHS, axis=2)
            amplitudes = part.inverse @ cross
            amplitudes = np.where(self._terms.signed[:, None], amplitudes, np.maximum(amplitudes, 0))
            explained = (amplitudes * (2 * cross - part.ridge @ amplitudes)).sum(axis=1)
            contrast.append(-PIECES * np.log1p(-np.clip(explained, 0, 0.999)) - part.volume[:, None])
            cross = scipy.fft.irfft(part.counts * phases, AZIMUTHS, axis=3)
            amplitudes = part.inverse_counts @ cross
            both = (amplitudes * cross).sum(axis=2)
            single = np.maximum(cross, 0) ** 2 / part.norms[..., None]
            explained = np.where((amplitudes >= 0).all(axis=2), both, single.max(axis=2)).max(axis=1)
            counted.append(-COUNTS * np.log1p(-np.clip(explained, 0, 0.999)))
        return np.array([contrast, counted])

    def _criterion(self, criterion, phases):
        if phases is None:
            if self._own is None:
                values = self._values(np.float32(1))
                self._own = values
            contrast, counted = self._own
        else:
            contrast, counted = self._values(phases)
        return (contrast, counted, contrast + counted)[criterion]

    def starts(
        self, criterion: int, n_max: int, *, marked: bool = True, phases: np.ndarray | None = None
    ) -> list[Start]:
        """Best orientations by a criterion, each more than two steps from a better one.

        Parameters
        ----------
        criterion : int
            `CONTRAST`, `COUNTED` or `JOINT`.
        n_max : int
            Largest number of orientations.
        marked : bool
            Whether the marks count, each with its squared deviation in standard errors.
        phases : ndarray, optional
            Factors of the harmonics of a surrogate of the map, shape (AZIMUTHS // 2 + 1,).
        """
        values = self._criterion(criterion, phases)
        if marked:
            values = values - self._costs
        azimuth, best = values.argmax(axis=2), values.max(axis=2)
        angles = polar_grid(RINGS, AZIMUTHS)[1]
        scored = []
        for place in np.argsort(-best, axis=None, kind="stable")[:_SORTED]:
            k, turn = divmod(int(place), best.shape[1])
            part = self._slices[k]
            scored.append((float(best[k, turn]), part.scale, self._turns[turn], part.mirror, angles[azimuth[k, turn]]))
        return distinct_starts(scored, self._proper, n_max, AXIS_STEP, SCALE_STEP)

    @property
    def largest(self) -> float:
        """Largest value of the joint criterion, without marks."""
        return float(self._criterion(JOINT, None).max())


def _products(spectra, picture):
    """Products of spectra, shape (n, ..., rings, f), with that of a picture, summed over rings, (n, 2, ..., f).

    Both hands: of the mirrored pattern the spectrum is not conjugated, so of the map it is.
    """
    # sums with the real and with the imaginary part of the picture, of both parts of the spectra side by side
    real, imaginary = (
        np.einsum("...rf,rf->...f", spectra.view(part.dtype), part.repeat(2, axis=1)).view(spectra.dtype)
        for part in (picture.real, picture.imag)
    )
    return np.stack([real.conj() + 1j * imaginary.conj(), real + 1j * imaginary], axis=1)


@lru_cache(maxsize=32)
def _spectrum_of_counts(disc, scale):
    """Spectrum of the flattened counts of a map, smoothed by the same angle as the patterns; for all structures."""
    counts = flattened(disc, np.radians(SMOOTHED) * scale)
    return scipy.fft.rfft((counts / max(np.linalg.norm(counts), 1e-12)).astype(np.float32), axis=1)


def _costs(disc, marks, turns, scale):
    """Misfits of the marks for all axes and azimuths, for both hands, each of shape (axes, azimuths) or (1, 1)."""
    if not marks:
        return [np.zeros((1, 1))] * 2
    azimuths = polar_grid(RINGS, AZIMUTHS)[1]
    marked = [Projection(scale, disc.centre).directions(mark.places) for mark in marks]
    return [
        np.array([rotations_misfit(marks, marked, oriented(turn, mirror, 0.0), azimuths) for turn in turns])
        for mirror in (False, True)
    ]


@lru_cache(maxsize=16)
def smoothed_pattern(pattern: MasterPattern) -> np.ndarray:
    """Densities of a pattern, smoothed for the steps of the search."""
    return pattern.smoothed(SMOOTHED).astype(np.float32)
