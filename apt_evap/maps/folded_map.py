"""Maps folded about a pole: the symmetric parts of a map are averaged, and two such maps are correlated.

A pole with the symmetry 2mm shows each of its lines four times. The mean over these four has half the noise, and what
the crystal does not have, such as gradients over the detector, is averaged out. Two maps are folded in the frame of the
crystal, so they need neither the same bins nor the same projection.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike

from apt_evap._common.types import Floats, Integers
from apt_evap._common.validation import check_choice, check_kind, check_number, check_seed
from apt_evap.detection.detector_map import DetectorMap, gaussian, masked_gaussian
from apt_evap.maps.pole_frame import Directions, axes_about, pole_frame, unit_vector

SYMMETRIES = ("1", "2", "3", "4", "6", "m", "2mm", "3m", "4mm", "6mm")
STEP = 0.25  # degrees: less than half of the default smoothing
BROAD = 6.0  # degrees: wider than a zone line, narrower than the range of a map
_COVERED = 0.5  # part of the solid angle of a cell that one of its symmetric places must have on the map
_LEAST_CELLS = 100  # of a correlation


@dataclass(frozen=True, eq=False)
class FoldedMap:
    """Density about a pole, averaged over the symmetric parts of a map; result of `folded`.

    Parameters
    ----------
    density : ndarray, shape (n, n)
        Relative to its mean; NaN outside the map and the reach. The first axis is the azimuth of 90 degrees.
    angles : ndarray, shape (n,)
        Angle from the pole along the azimuths of 0 and of 90 degrees [degrees].
    symmetry : str
        Such as "2mm".
    smoothing : float
        Standard deviation of the Gaussian [degrees].
    ions : float
        Hits on the folded part of the map; for densities the number with the same noise, NaN if it is not known.
    halves : float
        Correlation of the folded maps of two random halves of the ions; NaN if not known.
    """

    density: np.ndarray
    angles: np.ndarray
    symmetry: str
    smoothing: float
    ions: float
    halves: float

    @cached_property
    def flattened(self) -> Floats:
        """Density over its mean within 6 degrees, shape (n, n)."""
        known = np.isfinite(self.density)
        broad = masked_gaussian(self.density, known, [BROAD / STEP] * 2)
        return np.divide(self.density, broad, out=np.full(known.shape, np.nan), where=known & (broad > 0))

    @property
    def ceiling(self) -> float:
        """Correlation with the same map without noise, from the two halves; NaN if not known.

        With the correlation h of two halves it is sqrt(2 h / (1 + h)) (Spearman 1910, Brown 1910).
        """
        halves = max(self.halves, 0.0) if np.isfinite(self.halves) else self.halves
        return float(np.sqrt(2 * halves / (1 + halves)))

    def correlation(self, other: FoldedMap) -> float:
        """Correlation coefficient of the flattened densities of two maps, -1 to 1.

        Parameters
        ----------
        other : FoldedMap
            Of the same pole, reach and symmetry.

        Returns
        -------
        float
            NaN if one of the maps has no structure.

        Raises
        ------
        ValueError
            If the maps differ in symmetry or reach, or fewer than 100 cells are on both.
        """
        check_kind(other, "other", FoldedMap, "a FoldedMap")
        if (self.symmetry, len(self.angles)) != (other.symmetry, len(other.angles)):
            raise ValueError(f"other must have the symmetry and the reach of the map, got {other!r} and {self!r}")
        known = np.isfinite(self.flattened) & np.isfinite(other.flattened)
        if np.count_nonzero(known) < _LEAST_CELLS:
            raise ValueError(f"other must share at least {_LEAST_CELLS} cells with the map, got {known.sum()}")
        pair = self.flattened[known], other.flattened[known]
        if not all(values.std() > 0 for values in pair):
            return float("nan")
        return float(np.corrcoef(*pair)[0, 1])

    def __repr__(self) -> str:
        ceiling = "" if np.isnan(self.halves) else f", ceiling of a correlation {self.ceiling:.2f}"
        ions = "" if np.isnan(self.ions) else f" of {self.ions:,.0f} ions"
        return f"<FoldedMap{ions}: {self.symmetry}, up to {self.angles[-1]:g} degrees{ceiling}>"


def folded(
    map: DetectorMap,
    projection: Directions,
    pole: ArrayLike,
    symmetry: str,
    toward: ArrayLike | None = None,
    *,
    reach: float = 16.0,
    smoothing: float = 0.6,
    ions: float | None = None,
    seed: int | None = 0,
) -> FoldedMap:
    """Average the symmetric parts of a map about a pole.

    `Indexing.folded` does it for a pole of an indexed map, with the symmetry of the crystal.

    Parameters
    ----------
    map : DetectorMap
        Counts or densities, not smoothed.
    projection : Projection
        From directions in the specimen onto the detector.
    pole : array_like
        Direction of the pole in the frame of the projection, shape (3,).
    symmetry : str
        Symmetry about the pole: 1, 2, 3, 4, 6, m, 2mm, 3m, 4mm or 6mm, as from `pole_symmetry`.
    toward : array_like, optional
        Another direction, shape (3,): its azimuth is 0, and a mirror plane contains it. Required with mirror planes.
    reach : float
        Largest angle from the pole [degrees].
    smoothing : float
        Standard deviation of a Gaussian [degrees].
    ions : float, optional
        As for `ring_statistics`.
    seed : int or None
        Seed of the random halves of the ions; None for no halves.

    Returns
    -------
    FoldedMap

    Raises
    ------
    ValueError
        If an argument is outside its range, or the map has no hits within the reach.

    Notes
    -----
    Hits and solid angles of all bins are added in cells of 0.25 degrees at the places of all symmetric directions, and
    smoothed; the density is their ratio.

    Examples
    --------
    >>> run = ae.Simulation(ae.Tip("W", apex_radius=2.5, axis=(0, 1, 1)), seed=1).run(1_000)
    >>> pole = ae.Orientation.from_settings(run.settings["tip"]).nearest_pole((0, 1, 1))
    >>> projection = run.detector.seen_from_apex
    >>> maps = [run.hits(emission).map(bins=60) for emission in (ae.Unperturbed(), ae.RollUp(0.2))]
    >>> first, second = (ae.maps.folded(detector_map, projection, *pole, reach=30) for detector_map in maps)
    >>> print(first)
    <FoldedMap of 364 ions: 2mm, up to 30 degrees, ceiling of a correlation 0.86>
    >>> print(f"{first.correlation(second):.2f}")
    0.20
    """
    symmetry = check_choice(symmetry, "symmetry", SYMMETRIES)
    reach = check_number(reach, "reach", at_least=1, at_most=90, unit="degrees")
    smoothing = check_number(smoothing, "smoothing", at_least=STEP, at_most=BROAD, unit="degrees")
    seed = None if seed is None else check_seed(seed)
    frame = pole_frame(map, projection, pole, ions)
    turn = 0.0 if toward is None else _azimuth(unit_vector(pole), unit_vector(toward, "toward"))
    if toward is None and "m" in symmetry:
        raise ValueError(f"toward must be a direction in a mirror plane for the symmetry {symmetry}, got None")
    near = frame.angle < reach + 4 * smoothing  # of a Gaussian that ends at 4 sigma
    place = (frame.angle * np.exp(1j * (2 * np.pi * frame.azimuth - turn)))[near]
    hits, solid = frame.hits[near], frame.solid[near]
    if not hits[np.abs(place) <= reach].any():
        raise ValueError(f"{map!r} has no hits within {reach:g} degrees of the pole")
    density, angles = _folded(place, hits, solid, symmetry, reach, smoothing)
    halves = float("nan")
    if map.is_counts and seed is not None:
        half = np.random.default_rng(seed).binomial(np.rint(hits).astype(int), 0.5)
        parts = (_folded(place, part, solid, symmetry, reach, smoothing)[0] for part in (half, hits - half))
        unknown = float("nan")
        first, second = (FoldedMap(part, angles, symmetry, smoothing, unknown, unknown) for part in parts)
        halves = first.correlation(second)
    number = float(hits[np.abs(place) <= reach].sum()) if frame.noise_known else float("nan")
    return FoldedMap(density, angles, symmetry, smoothing, number, halves)


def symmetric_cells(
    map: DetectorMap,
    projection: Directions,
    pole: ArrayLike,
    symmetry: str,
    toward: ArrayLike,
    reach: float,
    size: float,
) -> Integers:
    """Number of the cell about a pole to which every bin of a map belongs; symmetric places have the same cell.

    Arguments as for `folded`, `size` is the edge of a cell [degrees]; -1 outside the mask and the reach.
    """
    frame = pole_frame(map, projection, pole, np.inf)
    order = int(symmetry[0]) if symmetry[0].isdigit() else 1
    azimuth = (2 * np.pi * frame.azimuth - _azimuth(unit_vector(pole), unit_vector(toward, "toward"))) % (
        2 * np.pi / order
    )
    if "m" in symmetry:
        azimuth = np.minimum(azimuth, 2 * np.pi / order - azimuth)
    place = frame.angle * np.exp(1j * azimuth)
    labels = np.full(map.values.shape, -1)
    column, row = (np.floor(angle / size).astype(int) for angle in (place.real, place.imag))
    width = 2 * math.ceil(reach / size) + 2
    labels[map.mask] = np.where(frame.angle < reach, (row + width // 2) * width + column + width // 2, -1)
    return labels


def _azimuth(pole, toward):
    """Azimuth of a direction about a pole, as in a `PoleFrame` [rad]."""
    first, second = axes_about(pole)
    if np.hypot(toward @ first, toward @ second) < 1e-6:  # rounding of a direction
        raise ValueError(f"toward must be another direction than the pole, got {toward.tolist()}")
    return np.arctan2(toward @ second, toward @ first)


def _folded(place, hits, solid, symmetry, reach, smoothing):
    """Density in cells about the pole, relative to its mean, and the angles of the cells [degrees]."""
    number = int(np.ceil((reach + 4 * smoothing) / STEP))
    cells = 2 * number + 1
    sums = np.zeros((2, cells, cells))
    order = int(symmetry[0]) if symmetry[0].isdigit() else 1
    # every symmetric copy of the bins is counted into the cells
    for image in (place, place.conj()) if "m" in symmetry else (place,):
        for k in range(order):
            moved = image * np.exp(2j * np.pi * k / order)
            column, row = (np.rint(angle / STEP).astype(int) + number for angle in (moved.real, moved.imag))
            inside = (np.abs(column - number) <= number) & (np.abs(row - number) <= number)
            index = row[inside] * cells + column[inside]
            for total, values in zip(sums, (hits, solid), strict=True):
                total += np.bincount(index, values[inside], cells**2).reshape(cells, cells)
    hits, solid = (gaussian(total, [smoothing / STEP] * 2) for total in sums)
    angles = np.arange(-number, number + 1) * STEP
    known = (np.hypot(angles, angles[:, None]) <= reach) & (solid > _COVERED * np.radians(STEP) ** 2)
    # hits per solid angle, in the square around the reach
    density = np.full(known.shape, np.nan)
    density[known] = hits[known] / solid[known]
    inside = np.abs(angles) <= reach
    density = density[np.ix_(inside, inside)]
    return density / np.nanmean(density), angles[inside]
