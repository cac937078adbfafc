"""The phases beyond the field of view, continued from what is seen at its rim."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
import scipy

from apt_evap._common.types import Booleans, Floats

RING_GATE = 0.05
"""Largest share of a phase in the ring without any effect beyond it: 0 to 0.02 for spheres inside, 0.33 for layers."""
FLAT_GATE = 0.45
"""Largest thickness of a plane over its extent, third to second principal spread: 0.1 to 0.3 for layers."""

_BLOCKS = 60  # of the sequence
_SURE = 3.5  # standard deviations of the counts: fixed shares react to noise for 10 % of solute
_FEWEST = 50  # ions of a plane
_RING_FROM = 0.75  # of the half angle of the field of view, for what lies beyond it
_SECTORS = 8
_BIN = 0.25  # nm, of the depth in the ring
_TURNS = 6  # of the search for a plane
_PLANE_BIN = 0.2  # nm, across a plane


@dataclass(frozen=True, eq=False)
class Feature:
    """A phase, or the surroundings of a solute, by its ions.

    Parameters
    ----------
    membership : ndarray
        How far each ion belongs to it, about 0 to 1, shape (n,).
    own : ndarray of bool
        Ions that are its own by their label or their species, shape (n,).
    background, content : float
        Share of such ions in the matrix and in the feature: 0 and 1 for labels.
    ratio : float
        Its evaporation field relative to that of the matrix.
    content_error : float
        Standard error of its content.
    neighbours : int
        Ions that a membership is taken from; 1 for labels.
    """

    membership: Floats = field(repr=False)
    own: Booleans = field(repr=False)
    background: float
    content: float
    ratio: float
    content_error: float = 0.0
    neighbours: int = 1

    @property
    def members(self) -> Booleans:
        """Ions that belong to it, shape (n,)."""
        return self.membership > 0.5

    def share_in_ring(self, in_ring: Booleans) -> tuple[float, bool]:
        """Largest share of the feature in the ring in 60 blocks of the sequence, and whether it is beyond its noise."""
        blocks = np.minimum(np.arange(len(self.own)) * _BLOCKS // len(self.own), _BLOCKS - 1)
        # for labels, whose counts have no background, 0.7 blocks; else the noise has to be averaged
        blocks_wide = 0.7 if self.background == 0 else 1.5
        ions = scipy.ndimage.gaussian_filter1d(np.bincount(blocks, in_ring, _BLOCKS), blocks_wide)
        ours = scipy.ndimage.gaussian_filter1d(np.bincount(blocks, in_ring & self.own, _BLOCKS), blocks_wide)
        ions = np.maximum(ions, 1e-9)
        contrast = self.content - self.background
        share = (ours / ions - self.background) / contrast
        counted = ions * 2 * np.sqrt(np.pi) * blocks_wide
        noise = np.sqrt(self.background * (1 - self.background) / counted) / contrast
        beyond = (share > RING_GATE) & (share > _SURE * noise)
        return float(min(share.max(), 1.0)), bool(beyond.any())


@dataclass(frozen=True)
class Continuation:
    """How a feature is continued beyond the field of view.

    Parameters
    ----------
    way : str
        "none", "plane" or "ring".
    share : float
        Largest share in the ring.
    flatness : float
        Third to second principal spread; NaN if it is not needed.
    normal : tuple of float
        Normal of the plane.
    """

    way: str
    share: float
    flatness: float = float("nan")
    normal: tuple[float, ...] = ()


def continued(
    features: list[Feature], positions: Floats, in_ring: Booleans
) -> tuple[Callable[[Floats], Floats], list[Continuation]]:
    """Evaporation field beyond the field of view relative to that of the matrix, and how each feature is continued.

    Parameters
    ----------
    features : list of Feature
        The phases.
    positions : ndarray
        Positions of the pass before [nm], shape (n, 3).
    in_ring : ndarray of bool
        Which ions are in the ring, shape (n,).

    Returns
    -------
    callable, list of Continuation
    """
    parts: list[Callable[[Floats], Floats]] = []
    ways = []
    for feature in features:
        share, reaches = feature.share_in_ring(in_ring)
        if not reaches or np.count_nonzero(feature.members) < _FEWEST:
            ways.append(Continuation("none", share))
            continue
        profile, flatness, normal = _plane(feature, positions)
        if flatness > FLAT_GATE:
            profile = _ring(feature, positions)
        ways.append(Continuation("ring" if flatness > FLAT_GATE else "plane", share, flatness, tuple(normal)))
        parts.append(profile)

    def outside(places):
        return np.clip(1.0 + sum(part(places) for part in parts), 0.4, 2.5) if parts else np.ones(places.shape[:-1])

    return outside, ways


def _plane(feature, positions):
    """Excess of the field as a function of the place across a plane, how flat the ions are, and the normal."""
    chosen = feature.members
    for _ in range(_TURNS):  # ions beyond two half widths are left out
        ions, weights = positions[chosen], feature.membership[chosen]
        middle = np.average(ions, axis=0, weights=weights)
        spread, axes = np.linalg.eigh(np.cov((ions - middle).T, aweights=np.maximum(weights, 0)))
        normal, half = axes[:, 0], np.sqrt(3 * max(spread[0], 1e-9))
        across = (positions - middle) @ normal
        chosen = feature.members & (np.abs(across) < 2 * half)
    edges = np.arange(-3 * half, 3 * half, _PLANE_BIN)
    bins = np.digitize(across, edges)
    ions = np.bincount(bins, minlength=len(edges) + 1)
    share = np.bincount(bins, feature.membership, len(edges) + 1) / np.maximum(ions, 1)
    centres = np.append(edges[0] - _PLANE_BIN / 2, edges + _PLANE_BIN / 2)
    counted = ions > 30
    if np.count_nonzero(counted) < 2:
        return (lambda places: np.zeros(places.shape[:-1])), 1.0, normal
    centres, share = centres[counted], share[counted]

    def excess(places):
        place = (places - middle) @ normal
        return (feature.ratio - 1) * np.interp(place, centres, share, left=0.0, right=0.0)

    return excess, float(np.sqrt(spread[0] / spread[1])), normal


def _ring(feature, positions):
    """Excess of the field by the ions near the rim, as a function of azimuth and z."""
    across = np.hypot(*positions[:, :2].T)
    near = across > _RING_FROM * np.quantile(across, 0.99)
    azimuth, height = np.arctan2(positions[near, 1], positions[near, 0]), positions[near, 2]
    sectors = ((azimuth / (2 * np.pi)) % 1.0 * _SECTORS).astype(int) % _SECTORS
    bottom = height.min()
    bins = ((height - bottom) / _BIN).astype(int)
    shape = (_SECTORS, int(bins.max()) + 1)
    flat = np.ravel_multi_index((sectors, bins), shape)
    ions, ours = (
        np.bincount(flat, weights, shape[0] * shape[1]).reshape(shape)
        for weights in (np.ones(len(flat)), feature.membership[near])
    )
    # over neighbouring sectors and 0.2 nm of depth
    for axis, width in ((0, 0.7), (1, 0.8)):
        mode = "wrap" if axis == 0 else "reflect"
        ions, ours = (scipy.ndimage.gaussian_filter1d(part, width, axis, mode=mode) for part in (ions, ours))
    share = ours / np.maximum(ions, 1e-6)

    def excess(places):
        turn = (np.arctan2(places[..., 1], places[..., 0]) / (2 * np.pi)) % 1.0 * _SECTORS - 0.5
        level = np.clip((places[..., 2] - bottom) / _BIN - 0.5, 0, shape[1] - 1)
        return (feature.ratio - 1) * scipy.ndimage.map_coordinates(
            share, np.stack([turn, level]), order=1, mode="grid-wrap"
        )

    return excess
