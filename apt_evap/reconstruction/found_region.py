"""The specimen that a reconstruction has found: regions of its phases, and a tip of them."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import scipy

from apt_evap._common.types import Booleans, Floats
from apt_evap.reconstruction.beyond_view import Feature, continued
from apt_evap.reconstruction.evolving_surface import IonSequence
from apt_evap.specimen.materials import Material
from apt_evap.specimen.phases import Phase
from apt_evap.specimen.tip import Tip

_NEIGHBOURS = 25  # within the Gaussian that tells a phase from the matrix
_SEEN = 0.2  # of the density of ions: less is beyond the field of view
_BELOW = 1.5  # nm of atoms below the last ion
_SHANK = 1.5  # degrees, of a reconstruction with a constant radius


class FoundRegion:
    """Where a phase was found: half of the ions around belong to it; beyond them, as the reconstruction continued it.

    Parameters
    ----------
    positions : ndarray
        Ions [nm], with the centre of the first sphere as origin and z out of the specimen, shape (n, 3).
    feature : Feature
        The phase.
    in_ring : ndarray of bool
        Ions close to the rim of the field of view, shape (n,).
    volume : float
        Volume of the specimen per ion [nm^3].
    factor : float
        Of all lengths of the specimen over those of the reconstruction.
    """

    def __init__(
        self, positions: Floats, feature: Feature, in_ring: Booleans, volume: float, factor: float = 1.0
    ) -> None:
        self._beyond = continued([replace(feature, ratio=2.0)], positions, in_ring)[0]
        self._factor = factor
        width = (_NEIGHBOURS * volume) ** (1 / 3) / math.sqrt(4 * math.pi)
        self._low, self._cell = positions.min(axis=0) - 3 * width, width / 1.5
        places = ((positions - self._low) / self._cell).astype(int)
        shape = places.max(axis=0) + 6
        flat = np.ravel_multi_index(tuple(places.T), tuple(shape))
        counts = [
            np.bincount(flat, weights, int(shape.prod())).reshape(shape) for weights in (None, feature.membership)
        ]
        self._ions, self._ours = (scipy.ndimage.gaussian_filter(count.astype(float), 1.5) for count in counts)
        self._least = _SEEN * self._cell**3 / volume

    def __call__(self, points: Floats) -> Booleans:
        """Whether points of the specimen (n, 3) [nm] belong to the phase, bool (n,)."""
        places = np.asarray(points) / self._factor
        at = ((places - self._low) / self._cell - 0.5).T
        ions, ours = (scipy.ndimage.map_coordinates(part, at, order=1) for part in (self._ions, self._ours))
        return np.where(ions > self._least, ours > 0.5 * ions, self._beyond(places) > 1.5)


def found_tip(
    positions: Floats,
    ions: IonSequence,
    features: Sequence[tuple[str, Feature]],
    crystal: Material,
    axis: Sequence[float],
    radius: float,
) -> Tip:
    """Tip with the phases where they were found; all lengths in the scale of its radius [nm].

    `positions` [nm] are as for `FoundRegion`, `ions` the same on the detector; `features` are names and phases, with
    the evaporation fields that were found. `axis` is a direction of the crystal.
    """
    factor = radius / ions.radius
    parts = [Phase("matrix", crystal)]
    for name, feature in features:
        region = FoundRegion(positions, feature, ions.in_ring, ions.volume, factor)
        parts.append(Phase(name, crystal, region, evaporation_field=feature.ratio * crystal.evaporation_field))
    slope = ions.growth / (1 + ions.growth)
    depth = factor * float(ions.radius - positions[:, 2].min()) + _BELOW
    return Tip(
        phases=parts, apex_radius=radius, axis=axis, shank_angle=math.degrees(math.asin(slope)) or _SHANK,
        shank_length=max(2 * radius, depth), depth=depth, offset_seed=1, seed=1,
    )  # fmt: skip
