"""Maps of the hits on the detector, with bins that avoid stripes from the quantisation of measured coordinates."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

from apt_evap._common.notebook import as_picture
from apt_evap._common.optional_imports import optional_import
from apt_evap._common.types import Booleans, Floats, Integers
from apt_evap._common.validation import check_array, check_kind, check_number, check_seed, check_switch
from apt_evap.detection.binning import bin_edges, count, field_of_view, find_quantisations, shown_bins
from apt_evap.warnings import MapWarning, warn

if TYPE_CHECKING:
    import xarray

_MAX_IONS = 2**53  # integers up to here are exact as float64, the type of sums and densities


class MapInput(Protocol):
    """Interface of the ions that a map is made of; `Hits` has it, and makes maps itself."""

    def require(self, *names: str) -> Any:
        """Return columns, or refuse ions that do not have them (ValueError)."""
        ...

    def __len__(self) -> int: ...

    @property
    def detected(self) -> Any:
        """Ions that hit the detector, bool (n,)."""
        ...

    @property
    def extent(self) -> Any:
        """Edges of the detector [mm], None if not known."""
        ...

    @property
    def source(self) -> str:
        """Origin of the ions."""
        ...


class BlockInput(Protocol):
    """Interface of ions that are read block by block; `IonBlocks` has it."""

    source: str

    @property
    def field(self) -> Any:
        """Extent of the detected ions."""
        ...

    @property
    def sample(self) -> Any:
        """Coordinates x and y of every nth of the detected ions."""
        ...

    def fed(self, make: Any, *columns: str) -> Any:
        """A consumer that has taken all blocks."""
        ...


@dataclass(frozen=True, eq=False, repr=False)
class DetectorMap:
    """Hits on the detector in bins of equal size; made by `from_hits` or `from_array`.

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
    position_step : tuple of float or None
        Quantisation step of the coordinates in x and y [mm]; None if they are continuous.
    smoothing : float
        Standard deviation of the Gaussian smoothing of the density [mm].
    source : str
        Origin of the map.
    detected : int or None
        Number of hits in the input of `from_hits`, including those outside the map or its mask; None if not known.

    Examples
    --------
    >>> x, y = np.random.default_rng(1).uniform(-20, 20, (2, 1000))
    >>> hit_map = ae.Hits(x=x, y=y).map(bins=32, extent=(-20, 20, -20, 20))
    >>> hit_map
    <DetectorMap: 1,000 ions, 32 x 32 bins of 1.25 x 1.25 mm>
    >>> hit_map.smoothed(2.0)
    <DetectorMap: 1,000 ions, 32 x 32 bins of 1.25 x 1.25 mm, smoothed by 2 mm>
    """

    values: np.ndarray
    x_edges: np.ndarray
    y_edges: np.ndarray
    mask: np.ndarray
    is_counts: bool = False
    ions: int | None = None
    position_step: tuple | None = None
    smoothing: float = 0.0
    source: str = ""
    detected: int | None = None

    @classmethod
    def from_hits(
        cls,
        hits: MapInput,
        bins: int = 256,
        extent: tuple[float, float, float, float] | None = None,
        position_step: str | tuple[float, float] | None = "auto",
        dither_seed: int | None = None,
        mask: ArrayLike | None = None,
        like: DetectorMap | None = None,
    ) -> DetectorMap:
        """Count the detected ions in approximately square bins.

        Measured coordinates are quantised. Bins that are not multiples of the quantisation step alias into stripes. So
        the bins become multiples of this step, with edges half way between its values: they are then not exactly
        square, and their number is not exactly `bins`. With `dither_seed` every hit is moved at random within one step
        instead, and the bins are square.

        Parameters
        ----------
        hits : Hits
            Ions with x and y.
        bins : int
            Number of bins along the longer side; approximate for quantised coordinates.
        extent : tuple of float, optional
            x_min, x_max, y_min, y_max [mm]. By default that of the detector for the hits of a run, and that of the
            detected hits, without strays, for measured ions. Bins may extend slightly beyond it.
        position_step : {"auto", None} or tuple of float
            Quantisation step in x and y [mm]; "auto" to find it in the data, None for continuous data.
        dither_seed : int, optional
            Seed of a dither by one quantisation step, instead of bins that are multiples of it.
        mask : array_like, optional
            Which bins are inside the detector. By default those on the detector of a run (`Hits.extent`). For measured
            ions the convex outline of the field of view, where the density exceeds a tenth of its median.
        like : DetectorMap, optional
            Use edges and mask of this map instead of `bins` and `extent`, for comparison.

        Returns
        -------
        DetectorMap

        Raises
        ------
        ValueError
            If x or y is missing, no ion was detected, no ion is within the extent, or an argument is outside its range.
        """
        x, y = check_kind(hits, "hits", "require", "Hits").require("x", "y")
        if like is not None:
            check_kind(like, "like", cls, "a DetectorMap")
        if dither_seed is not None:
            check_seed(dither_seed, "dither_seed")
        detected = hits.detected
        if not detected.any():
            raise ValueError(f"a map needs detected ions, got none of {len(hits)} in {hits.source or 'these hits'}")
        if not detected.all():
            x, y = x[detected], y[detected]

        quantisations = find_quantisations(x, y, position_step)
        if dither_seed is not None:
            x, y = _dithered(x, y, quantisations, dither_seed)

        # edges: those of another map, or multiples of the quantisation step
        if like is not None:
            x_edges, y_edges, mask = like.x_edges, like.y_edges, like.mask if mask is None else mask
            if quantisations is not None and dither_seed is None and not _fits(like, quantisations):
                warn(
                    "the bins of the other map are not multiples of the quantisation step of these hits: stripes are "
                    "possible; dither_seed prevents them",
                    MapWarning,
                )
        else:
            extent = hits.extent if extent is None else extent
            x_edges, y_edges = bin_edges(x, y, bins, extent, quantisations if dither_seed is None else None)

        counts = count(x, y, x_edges, y_edges)
        return cls._counted(counts, x_edges, y_edges, mask, hits.extent, quantisations, hits.source, len(x))

    @classmethod
    def _counted(cls, counts, x_edges, y_edges, mask, extent, quantisations, source, detected):
        """The map of counts, with the bins inside the detector or the field of view."""
        if not counts.any():
            raise ValueError(
                f"none of {detected:,} hits is in x {x_edges[0]:g} to {x_edges[-1]:g}, "
                f"y {y_edges[0]:g} to {y_edges[-1]:g} mm"
            )
        if mask is not None:
            mask = _check_mask(mask, counts.shape)
        else:
            mask = field_of_view(counts) if extent is None else _on_detector(x_edges, y_edges, extent)
        spacings = (
            None if quantisations is None else tuple(float(quantisation.spacing) for quantisation in quantisations)
        )
        ions = int(counts[mask].sum())
        return cls(counts, x_edges, y_edges, mask, True, ions, position_step=spacings, source=source, detected=detected)

    @classmethod
    def from_blocks(cls, ions: BlockInput, bins: int | None = None) -> DetectorMap:
        """Count measured ions that are read block by block, as `from_hits`; the ions must not all lie at one place.

        Parameters
        ----------
        ions : IonBlocks
            A large file.
        bins : int, optional
            Number of bins along the longer side; by default those of a picture.

        Returns
        -------
        DetectorMap
        """
        counter = ions.fed(lambda: _BlockCounter(ions, bins), "x", "y")
        edges = counter.x_edges, counter.y_edges
        return cls._counted(counter.counts, *edges, None, None, counter.quantisations, ions.source, counter.detected)

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
    ) -> DetectorMap:
        """Make a map from an array, such as a published one.

        Parameters
        ----------
        values : array_like
            Densities in any unit, or hits per bin, shape (ny, nx), indexed [y, x]; NaN outside the detector.
        x_edges, y_edges : array_like
            Edges of the bins [mm], shapes (nx + 1,) and (ny + 1,), evenly spaced and increasing.
        mask : array_like, optional
            Which bins are inside the detector; by default those not NaN.
        is_counts : bool
            Whether `values` are hits per bin, as needed for Poisson errors.
        source : str
            Origin of the map.

        Returns
        -------
        DetectorMap

        Raises
        ------
        ValueError
            If shapes disagree, edges are not evenly spaced, values are negative or too many, or the mask is empty.
        """
        is_counts = check_switch(is_counts, "is_counts")
        check_kind(source, "source", str, "text")
        values = check_array(values, "values", ("ny", "nx"), finite=False)
        x_edges = _check_edges(x_edges, "x_edges", values.shape[1])
        y_edges = _check_edges(y_edges, "y_edges", values.shape[0])
        finite = np.isfinite(values)
        mask = _check_mask(finite if mask is None else mask, values.shape)
        if not (finite & mask).any():
            raise ValueError("values must be finite in at least one bin of the mask, got none")
        if values[finite].min() < 0:
            raise ValueError(f"values of a map must be >= 0, got {values[finite].min():g}")
        mask = mask & finite
        values = np.where(finite, values, 0.0)
        ions = None
        if is_counts:
            if (total := values.sum()) > _MAX_IONS:
                raise ValueError(f"values that are counts must add up to at most {_MAX_IONS}, got {total:g}")
            values = check_array(values, "values", ("ny", "nx"), dtype=np.int64)
            ions = int(values[mask].sum())
        return cls(values, x_edges, y_edges, mask, is_counts, ions, source=source)

    @cached_property
    def density(self) -> Floats:
        """Hits per area relative to their mean inside the detector, NaN outside, shape (ny, nx)."""
        mean = self.values[self.mask].mean()
        if not mean > 0:
            raise ValueError(f"the map {self.source} has no hits inside its mask")
        return np.where(self.mask, self.values / mean, np.nan)

    @property
    def counts(self) -> Integers:
        """Hits per bin, int64 of shape (ny, nx); a ValueError for a map of densities."""
        if not self.is_counts:
            raise ValueError(f"{self!r} contains densities, not counts of ions")
        return self.values

    @property
    def shown_ions(self) -> str:
        """Number of ions in the map as text, such as "945,058 of 945,211 ions" if some lie outside; "" if not known."""
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
        """Area of the map: x_min, x_max, y_min, y_max [mm]."""
        return tuple(float(edges[end]) for edges in (self.x_edges, self.y_edges) for end in (0, -1))

    @property
    def centres(self) -> tuple[Floats, ...]:
        """Centres of the bins in x and in y [mm], shapes (nx,) and (ny,)."""
        return tuple((edges[:-1] + edges[1:]) / 2 for edges in (self.x_edges, self.y_edges))

    def contains(self, x: ArrayLike, y: ArrayLike) -> NDArray[np.bool_]:
        """Whether points [mm] are in bins inside the mask; NaN is outside, as is what lies beyond the edges."""
        places = []
        for values, edges in ((y, self.y_edges), (x, self.x_edges)):
            index = np.searchsorted(edges, values) - 1
            places.append(np.where((index >= 0) & (index < len(edges) - 1), index, -1))
        row, column = places
        return (row >= 0) & (column >= 0) & self.mask[row, column]

    def __array__(self, dtype: Any = None, copy: bool | None = None) -> NDArray[Any]:
        """Values of the bins, shape (ny, nx), for functions of NumPy: ``np.asarray(hit_map)``."""
        return np.array(self.values, dtype) if copy else np.asarray(self.values, dtype)

    def to_xarray(self) -> xarray.DataArray:
        """Convert to a labelled array of xarray, an optional package.

        Returns
        -------
        xarray.DataArray
            Hits or densities with the dimensions y and x, NaN outside the detector; the coordinates are the centres of
            the bins [mm].

        Raises
        ------
        ImportError
            If xarray is not installed.
        """
        x, y = self.centres
        kind = "hits" if self.is_counts else "density"
        known = {"source": self.source, "ions": self.ions, "smoothing": self.smoothing}
        return optional_import("xarray", "to_xarray").DataArray(
            np.where(self.mask, self.values, np.nan),
            {"y": ("y", y, {"units": "mm"}), "x": ("x", x, {"units": "mm"})},
            ("y", "x"),
            kind,
            {name: value for name, value in known.items() if value not in (None, "")},
        )

    def smoothed(self, sigma: float) -> DetectorMap:
        """Smooth the density with a Gaussian inside the detector.

        The smoothed density is divided by the smoothed mask, so that it does not decrease at the rim.

        Parameters
        ----------
        sigma : float
            Standard deviation [mm].

        Returns
        -------
        DetectorMap
            A map of densities; the same map if sigma is 0.

        Raises
        ------
        ValueError
            If sigma is negative, or larger than the map.
        """
        sigma = check_sigma(sigma, "sigma", self)
        if sigma == 0:
            return self
        total = float(np.hypot(sigma, self.smoothing))
        return replace(self, values=self._smooth(sigma), is_counts=False, smoothing=total)

    def flattened(self, sigma: float) -> DetectorMap:
        """Remove slow variations over the detector: divide the density by the smoothed density.

        Parameters
        ----------
        sigma : float
            Standard deviation of the Gaussian [mm]; broader variations are removed.

        Returns
        -------
        DetectorMap
            A map of densities; the same map if sigma is 0.

        Raises
        ------
        ValueError
            If sigma is negative, or larger than the map.
        """
        sigma = check_sigma(sigma, "sigma", self)
        if sigma == 0:
            return self
        background = self._smooth(sigma)
        inside = self.mask & (background > 0)
        flat = np.divide(self.values, background, out=np.zeros_like(background), where=inside)
        return replace(self, values=flat, is_counts=False)

    def _smooth(self, sigma):
        width, height = self.bin_size
        return masked_gaussian(self.values, self.mask, (sigma / height, sigma / width))

    _repr_png_ = as_picture

    def __repr__(self) -> str:
        ny, nx = self.values.shape
        width, height = self.bin_size
        what = "densities" if self.ions is None else self.shown_ions
        smoothing = f", smoothed by {self.smoothing:g} mm" if self.smoothing else ""
        source = f" from {self.source!r}" if self.source else ""
        return f"<DetectorMap: {what}{source}, {nx} x {ny} bins of {width:.4g} x {height:.4g} mm{smoothing}>"


class _BlockCounter:
    """Counts of ions that are read block by block, in bins that suit all of them."""

    def __init__(self, ions: BlockInput, bins: int | None) -> None:
        self.quantisations = find_quantisations(*ions.sample)
        low, high = ions.field.low, ions.field.high
        x, y = (np.array(pair) for pair in zip(low, high, strict=True))
        bins = shown_bins(ions.field.ions) if bins is None else bins
        self.x_edges, self.y_edges = bin_edges(x, y, bins, None, self.quantisations)
        self.counts = np.zeros((len(self.y_edges) - 1, len(self.x_edges) - 1), np.int64)
        self.detected = 0

    def add(self, hits: Any) -> None:
        """Count the next block."""
        x, y = hits.x, hits.y
        detected = hits.detected
        if not detected.all():
            x, y = x[detected], y[detected]
        self.detected += len(x)
        self.counts += count(x, y, self.x_edges, self.y_edges)


def check_sigma(sigma: object, name: str, map: DetectorMap) -> float:
    """Return a standard deviation [mm] from 0 to the longer side of a map, or raise a ValueError with its name."""
    longer = max(map.extent[1] - map.extent[0], map.extent[3] - map.extent[2])
    return check_number(sigma, name, at_least=0, at_most=longer, unit="mm")


def masked_gaussian(values: Floats, mask: Booleans, sigmas: ArrayLike) -> Floats:
    """Smooth maps (..., ny, nx) with a Gaussian inside a mask, standard deviations along y and x in bins; 0 outside it.

    The result is the smoothed values divided by the smoothed mask.
    """
    smooth = gaussian(np.where(mask, values, 0).astype(float), sigmas)
    return np.divide(smooth, gaussian(mask.astype(float), sigmas), out=np.zeros_like(smooth), where=mask)


def gaussian(values: Floats, sigmas: ArrayLike, truncate: float = 4.0) -> Floats:
    """Gaussian filter of maps of shape (..., ny, nx), with zeros outside; `sigmas` as for `masked_gaussian`.

    It has the bits of ``scipy.ndimage.gaussian_filter``, whose import takes as long as a map.
    """
    smooth = np.array(values, dtype=float, order="C")  # whose maps are views
    for axis, sigma in zip((-2, -1), np.broadcast_to(sigmas, 2), strict=True):
        reach = int(truncate * sigma + 0.5)
        if reach:
            weights = np.exp(-0.5 / (sigma * sigma) * np.arange(-reach, reach + 1) ** 2)
            for map in smooth.reshape(-1, *smooth.shape[-2:]).swapaxes(-2, axis):
                _filter_columns(map, weights / weights.sum())
    return smooth


def _filter_columns(map, weights):
    """Replace the columns of a map by their sums with symmetric weights; the far ones are added first, as by SciPy."""
    reach, size = len(weights) // 2, len(map)
    wide = np.zeros_like(map, shape=(size + 2 * reach, map.shape[1]))
    wide[reach : reach + size] = map
    map *= weights[reach]
    pair = np.empty_like(map)
    for first in range(reach):
        last = 2 * reach - first
        np.add(wide[first : first + size], wide[last : last + size], out=pair)
        pair *= weights[first]
        map += pair


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
        raise ValueError("mask must contain at least one bin inside the detector, got none")
    return mask


def _on_detector(x_edges, y_edges, extent):
    """Whether the centre of each bin is on a detector with this extent."""
    x, y = ((edges[1:] + edges[:-1]) / 2 for edges in (x_edges, y_edges))
    columns = (extent[0] <= x) & (x <= extent[1])
    rows = (extent[2] <= y) & (y <= extent[3])
    return rows[:, None] & columns


def _dithered(x, y, quantisations, seed):
    """Coordinates moved at random within one quantisation step."""
    if quantisations is None:
        raise ValueError(
            "dither_seed needs a quantisation step of the coordinates (position_step), but they are continuous"
        )
    random = np.random.default_rng(seed)
    return [
        values + quantisation.spacing * (random.random(len(values)) - 0.5)
        for values, quantisation in zip((x, y), quantisations, strict=True)
    ]


def _fits(like, quantisations):
    """Whether the bins of a map are multiples of the quantisation steps."""
    multiples = [size / quantisation.spacing for size, quantisation in zip(like.bin_size, quantisations, strict=True)]
    return all(multiple > 0.99 and abs(multiple - round(multiple)) < 1e-3 for multiple in multiples)
