"""Checks that the best orientation of a map can fail: a second lattice in a part of it, and surrogates of the map.

**Halves.** In each of eight half discs the evidence of the local contrast is computed for all orientations at the scale
of the winner. Where another orientation has more evidence than the winner, and than no crystal (0), the map may hold a
second lattice. A half without evidence is no second lattice, unless the whole map is clear.

**Segments.** A small grain at the rim has too few independent pieces for amplitudes of its own. So the amplitudes of
the winner are kept: its picture says what any orientation of the same crystal would show in a segment of the disc. The
logarithm of the likelihood ratio of the best other orientation and of the winner, both with these amplitudes, is the
evidence of a second grain. In a grain of the winner its own lines are there, and the ratio is negative.

**Rim.** In a smaller segment any orientation may seem likely, but the winner must be seen: its pattern of counts, with
the amplitudes of the whole map, is compared with no pattern at all.

**Surrogates.** A surrogate of a map has the same harmonics of every ring, but each harmonic with a random phase, the
same for all rings and for counts and contrast. Rings, radial changes and the width of lines stay; what belongs to one
crystal does not (J. Theiler et al., Physica D 58, 77 (1992)). The map must reach a larger weight than its surrogates,
each searched and refined as the map is.
"""

import math
from typing import NamedTuple

import numpy as np
import scipy

from apt_evap._common.types import Floats
from apt_evap.maps.indexing.contrast_search import PIECES, Terms, evidence, exact_evidence, places_of, refine_contrast
from apt_evap.maps.indexing.joint_search import JOINT, JointSearch
from apt_evap.maps.indexing.master_pattern import sampled
from apt_evap.maps.indexing.orientation_search import AZIMUTHS, RINGS, Start, about_axis, axes_of, polar_grid
from apt_evap.maps.indexing.refine import Refined, directions_of, refine
from apt_evap.maps.indexing.two_criteria import View
from apt_evap.specimen.symmetry import point_group

HALVES = 8
"""Half discs, 45 degrees apart."""
FAR = 8.0
"""Angle to the winner above which an orientation is another one [degrees]."""
STEP = 4.0
"""Distance of neighbouring axes in the search of the halves [degrees]."""
FEW, MANY, SURE = 8, 20, 7.0
"""Surrogates at first, and of a map that is not SURE standard deviations above the first ones."""
_NEAR = (-2.4, 0.0, 2.4)  # degrees about three axes by which the winner is freed in a half
_SCALES, _STRETCHES = (0.93, 1.0, 1.07), (1.0, 0.5)  # factors of its scale and stretch
CHORDS, SEGMENTS = (0.0, 0.3, 0.5), 16
"""Distances of the chords beyond which segments of the disc are searched [radii], with 50, 31 and 20 % of its area, and
azimuths of each. Beyond a chord at 0.65 radii measured nickel has 24, by the lens at its rim."""
RIM_CHORDS, RIM_SEGMENTS = (0.59, 0.66, 0.74, 0.81), 24
"""The same of the segments in which the winner must be seen, with 16, 12, 8 and 5 % of the area."""
_SEGMENT_STEP = 3.0  # degrees: distance of neighbouring axes in the search of the segments
_FREED, _SEGMENT_SCALES = (-2.0, 0.0, 2.0), (0.95, 1.0, 1.05)  # degrees and factors by which the winner is freed there
_AT_ONCE = 40  # axes
_STEPS = 7  # of the refinement of a surrogate
_POLAR_RINGS, _POLAR_AZIMUTHS = 48, 192  # of the counts: about the bins of the refinement
_FILLED = 1.5  # bins: smoothing of what fills the corners of a map


def second_lattice(view: View, terms: Terms, fit: Refined) -> tuple[float, float]:
    """Evidence of the local contrast for a second lattice, and that of the winner in the half where it has least.

    The first one is the largest evidence of another orientation over that of the winner, or of no crystal, in any half.
    """
    windows = _windows()
    pictures = _in_windows(view.picture, windows)
    winner = _of_winner(view, terms, fit, windows, pictures)
    excess = _of_others(view, terms, fit, windows, pictures) - np.maximum(winner, 0)
    return float(excess.max()), float(winner.min())


def _windows():
    """Areas of the points of a polar picture in every half disc, with a sum of 1, shape (HALVES, n)."""
    areas = places_of()[1].reshape(RINGS, AZIMUTHS)
    windows = np.zeros((HALVES, RINGS, AZIMUTHS))
    for k in range(HALVES):
        inside = (np.arange(AZIMUTHS // 2) - AZIMUTHS // 4 + k * AZIMUTHS // HALVES) % AZIMUTHS
        windows[k][:, inside] = areas[:, inside]
    return windows.reshape(HALVES, -1) / windows.sum(axis=(1, 2))[:, None]


def _in_windows(picture, windows):
    """The picture with a mean of 0 and a variance of 1 in every half, times the areas, shape (HALVES, n)."""
    centred = picture - (windows @ picture)[:, None]
    return centred / np.sqrt((windows * centred**2).sum(axis=1))[:, None] * windows


def _evidence(terms, gram, cross):
    """Evidence of half a picture for products of terms, shape (..., k, k), and with it, shape (..., k)."""
    return evidence(gram, cross[..., None], terms.priors, terms.signed, PIECES / 2)[..., 0]


def _of_winner(view, terms, fit, windows, pictures):
    """Largest evidence of orientations near the winner in every half, shape (HALVES,)."""
    turns = [
        scipy.spatial.transform.Rotation.from_rotvec((x, y, z), degrees=True).as_matrix()
        for x in _NEAR
        for y in _NEAR
        for z in _NEAR
    ]
    near = np.array(turns) @ fit.matrix
    best = np.full(HALVES, -np.inf)
    for factor in _SCALES:
        for part in _STRETCHES if abs(fit.stretch) > 0.01 else (1.0,):
            local = directions_of(places_of()[0], view.disc.radius, factor * fit.scale, part * fit.stretch)
            shown, _ = terms.at((local @ near).reshape(-1, 3), view.disc.radius / (factor * fit.scale))
            shown = shown.reshape(len(shown), len(near), -1).swapaxes(0, 1).astype(np.float32)
            for k, (window, picture) in enumerate(zip(windows.astype(np.float32), pictures, strict=True)):
                # half of the points are in a half
                inside = window > 0
                weights, terms_in = window[inside], shown[:, :, inside]
                terms_in = terms_in - (terms_in @ weights)[..., None]
                terms_in /= np.maximum(np.sqrt(terms_in**2 @ weights), 1e-3)[..., None]
                gram = ((terms_in * weights) @ terms_in.swapaxes(1, 2)).astype(float)
                cross = terms_in @ picture[inside]
                best[k] = max(best[k], _evidence(terms, gram, cross).max())
    return best


def _of_others(view, terms, fit, windows, pictures):
    """Largest evidence of orientations far from the winner in every half, at its scale, shape (HALVES,)."""
    group = point_group(terms.structure)
    proper = group[np.linalg.det(group) > 0]
    local = directions_of(places_of()[0], view.disc.radius, fit.scale, fit.stretch)
    spectra = scipy.fft.rfft(pictures.reshape(HALVES, RINGS, AZIMUTHS).astype(np.float32), axis=2)
    # mean of a half over its points: areas of the rings, and as many azimuths
    areas = places_of()[1].reshape(RINGS, AZIMUTHS)[:, 0]
    areas = (areas / areas.sum() * 2 / AZIMUTHS).astype(np.float32)
    angles = polar_grid(RINGS, AZIMUTHS)[1]
    about = np.stack([scipy.spatial.transform.Rotation.from_rotvec((0, 0, angle)).as_matrix() for angle in angles])
    turns = np.stack([about_axis(axis) for axis in axes_of(terms.structure, STEP)])
    turns = np.concatenate([turns, np.diag([1.0, -1.0, 1.0]) @ -turns])  # both hands
    # a pattern that is turned by an azimuth begins the half there before
    turned = (np.arange(HALVES)[:, None] * (AZIMUTHS // HALVES) - AZIMUTHS // 4 - np.arange(AZIMUTHS)) % AZIMUTHS
    best = np.full(HALVES, -np.inf)
    for first in range(0, len(turns), _AT_ONCE):
        some = turns[first : first + _AT_ONCE]
        shown, _ = terms.at((local @ some).reshape(-1, 3), view.disc.radius / fit.scale)
        shown = shown.reshape(len(shown), len(some), RINGS, AZIMUTHS).swapaxes(0, 1).astype(np.float32)
        # sums of the terms and of their products over halves that begin at every azimuth of the pattern
        along = np.moveaxis(shown, 3, 1)  # axes, azimuths, terms, rings
        means = _sums_of_halves(along @ areas)
        products = _sums_of_halves((along * areas) @ along.swapaxes(2, 3))
        products = products - means[..., :, None] * means[..., None, :]
        norms = np.maximum(np.sqrt(np.maximum(np.einsum("nakk->nak", products), 0)), 1e-3)
        gram = products / (norms[..., :, None] * norms[..., None, :])
        matrices = about @ some[:, None]
        traces = np.einsum("naij,gjk,ik->nag", matrices, proper, fit.matrix, optimize=True).max(axis=2)
        far = np.degrees(np.arccos(np.clip((traces - 1) / 2, -1, 1))) > FAR
        pattern = scipy.fft.rfft(shown, axis=3).conj()
        # of every half and every azimuth at which the half begins on the pattern: (halves, azimuths, axes, terms)
        cross = scipy.fft.irfft(np.einsum("nkrf,hrf->nhkf", pattern, spectra), AZIMUTHS, axis=3)
        cross = cross[:, np.arange(HALVES)[:, None], :, turned] / norms.swapaxes(0, 1)
        # the products of the terms are those of a half, whichever it is
        values = evidence(gram, cross.transpose(2, 1, 3, 0), terms.priors, terms.signed, PIECES / 2)
        values = np.where(far[:, turned].swapaxes(1, 2), values, -np.inf)
        best = np.maximum(best, values.max(axis=(0, 1)))
    return best


def _sums_of_halves(values):
    """Sums over half of the azimuths, axis 1, from each of them on."""
    twice = np.concatenate([values, values[:, : AZIMUTHS // 2]], axis=1, dtype=np.float64).cumsum(axis=1)
    twice = np.concatenate([np.zeros_like(twice[:, :1]), twice], axis=1)
    return twice[:, AZIMUTHS // 2 : AZIMUTHS // 2 + AZIMUTHS] - twice[:, :AZIMUTHS]


class SecondGrain(NamedTuple):
    """The segment of the disc in which the winner is least likely."""

    evidence: float
    """Twice the logarithm of the likelihood ratio of the best other orientation, or of no pattern, and the winner."""
    chord: float
    """Distance of the chord of the segment from the centre [radii]."""
    azimuth: float
    """Of the middle of the segment [degrees]."""


def second_grain(view: View, terms: Terms, fit: Refined) -> SecondGrain:
    """Likelihood of another orientation in a segment of the disc, with the amplitudes of the winner."""
    places, areas = places_of()
    radius, picture = view.disc.radius, view.picture
    # what the winner shows in any direction of the crystal, and the variance that it leaves
    local = directions_of(places, radius, fit.scale, fit.stretch)
    images = terms.images(radius / fit.scale)
    shown = sampled(images, terms.equal(local @ fit.matrix), terms.corner)
    shown = shown - (shown @ areas)[:, None]
    norms = np.maximum(np.sqrt(shown**2 @ areas), 1e-3)
    shown /= norms[:, None]
    _, amplitudes = exact_evidence((shown * areas) @ shown.T, (shown * areas) @ picture, terms.priors, terms.signed)
    left = 1 - areas @ (picture**2 - (picture - amplitudes @ shown) ** 2)
    weight = PIECES / max(float(left), 1e-3)
    image = np.tensordot((amplitudes / norms).astype(np.float32), images, 1)[None]

    def seen(matrices, directions):
        """Pictures of orientations, shape (n, points)."""
        pictures = sampled(image, terms.equal((directions @ matrices).reshape(-1, 3)), terms.corner)
        return pictures.reshape(len(matrices), -1)

    azimuths = np.arange(SEGMENTS) * (2 * math.pi / SEGMENTS)
    toward = places @ np.array([np.cos(azimuths), np.sin(azimuths)])
    segments = np.array([np.where(along > chord, areas, 0.0) for chord in CHORDS for along in toward.T])
    shares = segments.sum(axis=1)
    means = segments @ picture / shares

    winner = np.full(len(segments), -np.inf)
    turns = [(x, y, z) for x in _FREED for y in _FREED for z in _FREED]
    near = scipy.spatial.transform.Rotation.from_rotvec(turns, degrees=True).as_matrix() @ fit.matrix
    for factor in _SEGMENT_SCALES:
        pictures = seen(near, directions_of(places, radius, factor * fit.scale, fit.stretch))
        inside = pictures @ segments.T / shares
        gains = 2 * (pictures @ (segments * picture).T - inside * means * shares)
        gains -= pictures**2 @ segments.T - inside**2 * shares
        winner = np.maximum(winner, weight * gains.max(axis=0))

    group = point_group(terms.structure)
    proper = group[np.linalg.det(group) > 0]
    angles = polar_grid(RINGS, AZIMUTHS)[1]
    about = np.stack([scipy.spatial.transform.Rotation.from_rotvec((0, 0, angle)).as_matrix() for angle in angles])
    turns = np.stack([about_axis(axis) for axis in axes_of(terms.structure, _SEGMENT_STEP)])
    turns = np.concatenate([turns, np.diag([1.0, -1.0, 1.0]) @ -turns])  # both hands

    def spectra(values):
        return scipy.fft.rfft(values.astype(np.float32).reshape(len(values), RINGS, AZIMUTHS), axis=2)

    of_picture, of_segments = spectra(segments * picture), spectra(segments)
    other = np.full(len(segments), -np.inf)
    for first in range(0, len(turns), _AT_ONCE):
        some = turns[first : first + _AT_ONCE]
        pictures = seen(some, local)
        pictures = pictures - (pictures @ areas)[:, None]
        plain, squares = spectra(pictures).conj(), spectra(pictures**2).conj()
        matrices = about @ some[:, None]
        traces = np.einsum("naij,gjk,ik->nag", matrices, proper, fit.matrix, optimize=True).max(axis=2)
        far = np.degrees(np.arccos(np.clip((traces - 1) / 2, -1, 1))) > FAR
        # sums over every segment for every azimuth of the pattern, shape (axes, segments, azimuths)
        cross, inside = _correlations(plain, of_picture), _correlations(plain, of_segments)
        power = _correlations(squares, of_segments)
        gains = 2 * (cross - inside * means[:, None]) - (power - inside**2 / shares[:, None])
        gains = np.where(far[:, None], gains, -np.inf)
        other = np.maximum(other, weight * gains.max(axis=(0, 2)))
    best = int(np.argmax(other - winner))
    chord, segment = divmod(best, SEGMENTS)
    return SecondGrain(float((other - winner)[best]), CHORDS[chord], math.degrees(azimuths[segment]))


def unseen_grain(view: View, densities: Floats, fit: Refined) -> SecondGrain:
    """Likelihood of the counts in a segment at the rim without the pattern of the winner; densities as of `refine`."""
    _, bins, _ = view
    slow = np.exp(np.clip(bins.slow @ fit.slow, -20, 20))
    azimuths = np.arange(RIM_SEGMENTS) * (2 * math.pi / RIM_SEGMENTS)
    toward = bins.places @ np.array([np.cos(azimuths), np.sin(azimuths)])
    weights = np.array([np.where(along > chord, slow, 0.0) for chord in RIM_CHORDS for along in toward.T])
    # slopes of the density in a segment are not the pattern: orthonormal ones, shape (segments, 3, n)
    slopes = np.vstack([np.ones(len(slow)), bins.places.T])
    roots = np.linalg.cholesky((slopes * weights[:, None]) @ slopes.T + 1e-9 * slow.sum() * np.eye(3))
    slopes = np.linalg.solve(roots, slopes * weights[:, None])
    contrast = bins.counts / slow - 1
    image = np.tensordot(fit.amplitudes, densities, 1)[None]
    directions = directions_of(bins.places, view.disc.radius, fit.scale, fit.stretch)
    pattern = sampled(image, directions @ fit.matrix)[0] - fit.amplitudes.sum()
    of_pattern, of_counts = slopes @ pattern, slopes @ contrast
    gains = weights @ (pattern * (2 * contrast - pattern)) - (of_pattern * (2 * of_counts - of_pattern)).sum(axis=1)
    chord, segment = divmod(int(gains.argmin()), RIM_SEGMENTS)
    return SecondGrain(-float(gains.min() / fit.dispersion), RIM_CHORDS[chord], math.degrees(azimuths[segment]))


def _correlations(spectra, others):
    """Sums of products of pictures for every azimuth; spectra (n, rings, f), (m, rings, f) -> (n, m, azimuths)."""
    products = np.moveaxis(spectra, 2, 0) @ np.moveaxis(others, (2, 1), (0, 1))
    return scipy.fft.irfft(np.moveaxis(products, 0, 2), AZIMUTHS, axis=2)


class Surrogates(NamedTuple):
    """Weights of the surrogates of a map, and of the map itself."""

    own: float
    """Weight of the map, refined as its surrogates are."""
    weights: Floats
    """Those of the surrogates."""

    @property
    def above(self) -> int:
        """Number of surrogates with at least the weight of the map."""
        return int(np.count_nonzero(self.weights >= self.own))

    @property
    def deviations(self) -> float:
        """Standard deviations of the weights of the surrogates by which that of the map is above their mean."""
        return float((self.own - self.weights.mean()) / max(self.weights.std(ddof=1), 1e-9))


def surrogates_of(
    view: View, search: JointSearch, terms: Terms, densities: Floats, bounds: tuple[float, float], fit: Refined
) -> Surrogates:
    """Weights of surrogates of a map.

    `densities` are those of the patterns, smoothed for the bins, shape (k, m, m), `bounds` those of the scale [mm/rad],
    `fit` is the best orientation of the map.
    """
    disc, bins, picture = view
    polar = _polar(bins)
    random = np.random.default_rng(0)
    areas = places_of()[1]

    def weight(counts, picture, start, crossed):
        refined = refine(
            bins._replace(counts=counts), disc, densities, start.matrix, start.scale, None, (), _STEPS, bounds
        )
        evidence = refine_contrast(picture, disc.radius, terms, start, bounds).evidence
        if crossed:
            evidence = max(evidence, refine_contrast(picture, disc.radius, terms, refined, bounds).evidence)
        return refined.gain / refined.dispersion + evidence

    # the map through the same interpolation
    own = weight(_counts_of(polar, bins), picture, Start(fit.matrix, fit.scale, 0.0), True)
    weights: list[float] = []
    for number in range(MANY):
        turns = random.uniform(0, 2 * math.pi, _POLAR_AZIMUTHS // 2 + 1)
        turns[0] = 0
        phases = np.exp(1j * turns)
        few = phases[: AZIMUTHS // 2 + 1].astype(np.complex64)
        (start,) = search.starts(JOINT, 1, marked=False, phases=few)
        scrambled = _with_phases(picture.reshape(RINGS, AZIMUTHS), few).ravel()
        scrambled -= areas @ scrambled
        scrambled /= math.sqrt(areas @ scrambled**2)
        weights.append(weight(_counts_of(_with_phases(polar, phases), bins), scrambled, start, False))
        if number + 1 == FEW:
            result = Surrogates(own, np.array(weights))
            if not result.above and result.deviations > SURE:
                break
    return Surrogates(own, np.array(weights))


def _with_phases(values, phases):
    """Rows of values with their harmonics turned by these phases."""
    return scipy.fft.irfft(scipy.fft.rfft(values, axis=1) * phases, values.shape[1], axis=1)


def _polar(bins):
    """Ratio of the counts to their slow fit on a polar grid, shape (_POLAR_RINGS, _POLAR_AZIMUTHS)."""
    image = np.zeros(bins.inside.shape)
    image[bins.inside] = bins.counts / bins.mu
    smooth, area = (scipy.ndimage.gaussian_filter(values, _FILLED) for values in (image, bins.inside.astype(float)))
    image = np.where(bins.inside, image, np.where(area > 1e-3, smooth / np.maximum(area, 1e-3), 1.0))
    radii, azimuths = polar_grid(_POLAR_RINGS, _POLAR_AZIMUTHS)
    r, phi = np.meshgrid(radii, azimuths, indexing="ij")
    (column, x0), (row, y0) = (
        np.polyfit(bins.places[:, axis], np.nonzero(bins.inside)[1 - axis], 1) for axis in (0, 1)
    )
    pixels = [row * r * np.sin(phi) + y0, column * r * np.cos(phi) + x0]
    return scipy.ndimage.map_coordinates(image, pixels, order=1, mode="nearest")


def _counts_of(polar, bins):
    """Counts of the bins for ratios on the polar grid; outside the disc those of the map."""
    r, phi = np.hypot(*bins.places.T), np.arctan2(bins.places[:, 1], bins.places[:, 0]) % (2 * math.pi)
    around = np.concatenate([polar, polar[:, :1]], axis=1)
    pixels = [np.clip(r * _POLAR_RINGS - 0.5, 0, _POLAR_RINGS - 1), phi / (2 * math.pi) * _POLAR_AZIMUTHS]
    ratios = scipy.ndimage.map_coordinates(around, pixels, order=1, mode="nearest")
    return np.where(r <= 1, np.maximum(ratios, 0) * bins.mu, bins.counts)
