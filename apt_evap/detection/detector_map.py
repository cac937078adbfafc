"""Maps of the hits on the detector, binned so that the comb of measured coordinates does not show."""

import warnings
from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np
import scipy
from numpy.typing import ArrayLike

from apt_evap._common.types import Booleans, Floats, Integers
from apt_evap._common.validation import check_array, check_kind, check_number, check_seed, check_switch
from apt_evap._common.warnings import MapWarning
from apt_evap.detection.binning import bin_edges, count, field_of_view, find_combs

if TYPE_CHECKING:
    from apt_evap.detection.hits import Hits

_MOST_IONS = 2**53  # whole numbers up to here are exact as floats, which sums and densities are made of


@dataclass(frozen=True, eq=False, repr=False)
class DetectorMap:
    """Hits on the detector in bins of one size; made by `from_hits` or `from_array`.

    Parameters
    ----------
    values : ndarray
        Hits per bin, or a density in any unit, shape (ny, nx), indexed [y, x].
    x_edges, y_edges : ndarray
        Edges of the bins [mm], shapes (nx + 1,) and (ny + 1,), evenly spaced.
    mask : ndarray
        Whether a bin is inside the detector, bool of shape (ny, nx).
    is_counts : bool
        Whether `values` are hits per bin.
    ions : int or None
        Number of hits inside the detector, None if not known.
    quantum : tuple of float or None
        Spacing of the comb of the coordinates [mm] in x and y, None if they are continuous.
    smoothing : float
        Standard deviation of the Gaussian the density was smoothed with [mm].
    source : str
        What the map was made from.
    detected : int or None
        Number of hits that `from_hits` was given, those outside the map or its mask too; None if not known.
    """

    values: np.ndarray
    x_edges: np.ndarray
    y_edges: np.ndarray
    mask: np.ndarray
    is_counts: bool = False
    ions: int | None = None
    quantum: tuple | None = None
    smoothing: float = 0.0
    source: str = ""
    detected: int | None = None

    @classmethod
    def from_hits(
        cls,
        hits: "Hits",
        bins: int = 256,
        extent: tuple[float, float, float, float] | None = None,
        quantum: str | tuple[float, float] | None = "auto",
        dither_seed: int | None = None,
        mask: ArrayLike | None = None,
        like: "DetectorMap | None" = None,
    ) -> "DetectorMap":
        """Count the detected ions in bins that are as good as square.

        Measured coordinates lie on a comb; bins that are no multiple of its spacing, the quantum, hold now
        one tooth more, now one less, and show stripes. So the bins become multiples of the quantum, with
        edges half way between teeth: they are then not quite square and not exactly `bins` in number. With
        `dither_seed` every hit is moved at random within its quantum instead, and bins are square.

        Parameters
        ----------
        hits : Hits
            Ions with x and y.
        bins : int
            Number of bins along the longer side; about so many where the hits lie on a comb.
        extent : tuple of float, optional
            x_min, x_max, y_min, y_max [mm]; by default that of the detector for the hits of a run, that of the hits for
            measured ones. Bins may reach a little over it.
        quantum : {"auto", None} or tuple of float
            Spacing of the comb in x and y [mm], "auto" to find it in the data, None for continuous data.
        dither_seed : int, optional
            Seed; dithers by one quantum instead of fitting the bins to the comb.
        mask : array_like, optional
            Which bins are inside the detector. By default all that are for the hits of a run, whose detector is known
            (`Hits.extent`); for measured ones the convex outline of the field of view, where the density exceeds a
            tenth of its median.
        like : DetectorMap, optional
            Take edges and mask from this map, for comparison, instead of `bins` and `extent`.

        Returns
        -------
        DetectorMap

        Raises
        ------
        ValueError
            If x or y is missing, no ion was detected, none lies in the extent, or an argument is out of
            range.
        """
        x, y = check_kind(hits, "hits", "require", "Hits").require("x", "y")
        if like is not None:
            check_kind(like, "like", cls, "a DetectorMap")
        if dither_seed is not None:
            check_seed(dither_seed, "dither_seed")
        detected = hits.detected
        if not detected.any():
            raise ValueError(f"a map needs detected ions, {hits.source or 'these hits'} has none of {len(hits)}")
        if not detected.all():
            x, y = x[detected], y[detected]
        combs = find_combs(x, y, quantum)
        if dither_seed is not None:
            if combs is None:
                raise ValueError("dither_seed needs a quantum to dither by, and the coordinates show no comb")
            random = np.random.default_rng(dither_seed)
            x, y = (
                values + comb.spacing * (random.random(len(values)) - 0.5)
                for values, comb in zip((x, y), combs, strict=True)
            )
        if like is not None:
            x_edges, y_edges, mask = like.x_edges, like.y_edges, like.mask if mask is None else mask
            if combs is not None and dither_seed is None and not _fits(like, combs):
                warnings.warn(
                    "hits on a comb are binned on the edges of another map and may show stripes; dither_seed "
                    "prevents them",
                    MapWarning,
                    stacklevel=2,
                )
        else:
            extent = hits.extent if extent is None else extent
            x_edges, y_edges = bin_edges(x, y, bins, extent, combs if dither_seed is None else None)
        counts = count(x, y, x_edges, y_edges)
        if not counts.any():
            raise ValueError(
                f"none of {len(x):,} hits lies in x {x_edges[0]:g} to {x_edges[-1]:g}, "
                f"y {y_edges[0]:g} to {y_edges[-1]:g} mm"
            )
        if mask is not None:
            mask = _check_mask(mask, counts.shape)
        else:
            mask = field_of_view(counts) if hits.extent is None else _on_detector(x_edges, y_edges, hits.extent)
        spacings = None if combs is None else tuple(float(comb.spacing) for comb in combs)
        ions = int(counts[mask].sum())
        return cls(counts, x_edges, y_edges, mask, True, ions, quantum=spacings, source=hits.source, detected=len(x))

    @classmethod
    def from_array(
        cls,
        values: ArrayLike,
        x_edges: ArrayLike,
        y_edges: ArrayLike,
        mask: ArrayLike | None = None,
        *,
        is_counts: bool = False,
        source: str = "",
    ) -> "DetectorMap":
        """Make a map of a given array, such as a published one.

        Parameters
        ----------
        values : array_like
            Densities in any unit, or hits per bin, shape (ny, nx), indexed [y, x]; NaN is outside the
            detector.
        x_edges, y_edges : array_like
            Edges of the bins [mm], shapes (nx + 1,) and (ny + 1,), evenly spaced and increasing.
        mask : array_like, optional
            Which bins are inside the detector; by default those that are not NaN.
        is_counts : bool
            Whether `values` are hits per bin; Poisson errors need that.
        source : str
            What the map is.

        Returns
        -------
        DetectorMap

        Raises
        ------
        ValueError
            If shapes do not fit, edges are not even, values are negative or too many, or the mask is empty.
        """
        is_counts = check_switch(is_counts, "is_counts")
        check_kind(source, "source", str, "text")
        values = check_array(values, "values", ("ny", "nx"), finite=False)
        x_edges = _check_edges(x_edges, "x_edges", values.shape[1])
        y_edges = _check_edges(y_edges, "y_edges", values.shape[0])
        finite = np.isfinite(values)
        mask = _check_mask(finite if mask is None else mask, values.shape)
        if not (finite & mask).any():
            raise ValueError("values must be finite somewhere in the mask, got none there")
        if values[finite].min() < 0:
            raise ValueError(f"values of a map must be at least 0, got {values[finite].min():g}")
        mask = mask & finite
        values = np.where(finite, values, 0.0)
        ions = None
        if is_counts:
            if (total := values.sum()) > _MOST_IONS:
                raise ValueError(f"values that are counts must add up to at most {_MOST_IONS}, got {total:g}")
            values = check_array(values, "values", ("ny", "nx"), dtype=np.int64)
            ions = int(values[mask].sum())
        return cls(values, x_edges, y_edges, mask, is_counts, ions, source=source)

    @cached_property
    def density(self) -> Floats:
        """Hits per area relative to their mean inside the detector, NaN outside of it, shape (ny, nx)."""
        mean = self.values[self.mask].mean()
        if not mean > 0:
            raise ValueError(f"the map {self.source} has no hits inside its mask")
        return np.where(self.mask, self.values / mean, np.nan)

    @property
    def counts(self) -> Integers:
        """Hits per bin, int64 of shape (ny, nx); a ValueError for a map of densities."""
        if not self.is_counts:
            raise ValueError(f"{self!r} holds densities, not counts of ions")
        return self.values

    @property
    def shown_ions(self) -> str:
        """How many ions the map shows, such as "945,058 of 945,211 ions" where some lie outside; "" if not known."""
        if self.ions is None:
            return ""
        outside = f" of {self.detected:,}" if self.detected not in (None, self.ions) else ""
        return f"{self.ions:,}{outside} ions"

    @property
    def bin_size(self) -> tuple[float, ...]:
        """Width and height of a bin [mm]."""
        return tuple(float((edges[-1] - edges[0]) / (len(edges) - 1)) for edges in (self.x_edges, self.y_edges))

    @property
    def extent(self) -> tuple[float, ...]:
        """Where the map reaches: x_min, x_max, y_min, y_max [mm]."""
        return tuple(float(edges[end]) for edges in (self.x_edges, self.y_edges) for end in (0, -1))

    @property
    def centres(self) -> tuple[Floats, ...]:
        """Centres of the bins in x and in y [mm], shapes (nx,) and (ny,)."""
        return tuple((edges[:-1] + edges[1:]) / 2 for edges in (self.x_edges, self.y_edges))

    def smoothed(self, sigma: float) -> "DetectorMap":
        """Smooth the density with a Gaussian that sees only the inside of the detector.

        The smoothed density is divided by the smoothed mask, so that it does not fall off at the rim.

        Parameters
        ----------
        sigma : float
            Standard deviation [mm].

        Returns
        -------
        DetectorMap
            A map of densities; itself for a sigma of 0.

        Raises
        ------
        ValueError
            If sigma is negative, or larger than the map.
        """
        longer = max(self.extent[1] - self.extent[0], self.extent[3] - self.extent[2])
        sigma = check_number(sigma, "sigma", at_least=0, at_most=longer, unit="mm")
        if sigma == 0:
            return self
        total = float(np.hypot(sigma, self.smoothing))
        return replace(self, values=self._blurred(sigma), is_counts=False, smoothing=total)

    def flattened(self, sigma: float) -> "DetectorMap":
        """Divide the density by itself, smoothed broadly: what varies slowly over the detector goes.

        Parameters
        ----------
        sigma : float
            Standard deviation of the Gaussian of `smoothed` [mm]; variations broader than that go.

        Returns
        -------
        DetectorMap
            A map of densities; itself for a sigma of 0.

        Raises
        ------
        ValueError
            If sigma is negative.
        """
        sigma = check_number(sigma, "sigma", at_least=0, unit="mm")
        if sigma == 0:
            return self
        broad = self._blurred(sigma)
        flat = np.divide(self.values, broad, out=np.zeros_like(broad), where=self.mask & (broad > 0))
        return replace(self, values=flat, is_counts=False)

    def _blurred(self, sigma):
        width, height = self.bin_size
        return blurred(self.values, self.mask, (sigma / height, sigma / width))

    def __repr__(self) -> str:
        ny, nx = self.values.shape
        width, height = self.bin_size
        what = "densities" if self.ions is None else self.shown_ions
        smoothing = f", smoothed by {self.smoothing:g} mm" if self.smoothing else ""
        source = f" from {self.source!r}" if self.source else ""
        return f"<DetectorMap: {what}{source}, {nx} x {ny} bins of {width:.4g} x {height:.4g} mm{smoothing}>"


def blurred(values: Floats, mask: Booleans, sigmas: ArrayLike) -> Floats:
    """Smooth maps with a Gaussian that sees only the inside of a mask.

    Parameters
    ----------
    values : ndarray
        One map or several, shape (..., ny, nx).
    mask : ndarray
        Whether a bin is inside, bool of shape (ny, nx).
    sigmas : array_like
        Standard deviations along y and x [bins], shape (2,).

    Returns
    -------
    ndarray
        The smoothed values over the smoothed mask, 0 outside of the mask, of the shape of `values`.
    """
    smooth = gaussian(np.where(mask, values, 0).astype(float), sigmas)
    return np.divide(smooth, gaussian(mask.astype(float), sigmas), out=np.zeros_like(smooth), where=mask)


def gaussian(values: Floats, sigmas: ArrayLike, truncate: float = 4.0) -> Floats:
    """Gaussian filter of maps of shape (..., ny, nx), with nothing beyond their ends; lengths as for `blurred`."""
    return scipy.ndimage.gaussian_filter(values, sigmas, mode="constant", truncate=truncate, axes=(-2, -1))


def _check_edges(edges, name, bins):
    edges = check_array(edges, name, (bins + 1,))
    widths = np.diff(edges)
    if not (widths > 0).all() or np.ptp(widths) > 0.01 * widths.mean():
        raise ValueError(
            f"{name} must increase in even steps (to 1 %), got steps of {widths.min():g} to {widths.max():g}"
        )
    return edges


def _check_mask(mask, shape):
    mask = check_array(mask, "mask", shape, dtype=bool)
    if not mask.any():
        raise ValueError("mask must leave some bin inside the detector, got none")
    return mask


def _on_detector(x_edges, y_edges, extent):
    """Bins whose centres are on a detector of the given extent."""
    x, y = ((edges[1:] + edges[:-1]) / 2 for edges in (x_edges, y_edges))
    columns = (extent[0] <= x) & (x <= extent[1])
    rows = (extent[2] <= y) & (y <= extent[3])
    return rows[:, None] & columns


def _fits(like, combs):
    """Whether the bins of a map are whole multiples of the combs' spacings."""
    multiples = [size / comb.spacing for size, comb in zip(like.bin_size, combs, strict=True)]
    return all(multiple > 0.99 and abs(multiple - round(multiple)) < 1e-3 for multiple in multiples)
