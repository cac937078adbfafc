"""Simulated or measured ions: columns of equal length, one row per ion."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from enum import IntEnum
from numbers import Real
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

from apt_evap._common.codec import check_itself
from apt_evap._common.notebook import as_table
from apt_evap._common.types import Booleans, Column, Floats, Integers
from apt_evap._common.validation import (
    check_array,
    check_kind,
    check_number,
    check_seed,
    did_you_mean,
    short_text,
    without_mask,
)
from apt_evap.detection.binning import find_quantisations
from apt_evap.detection.correlation import Correlation, correlate
from apt_evap.detection.dataframe import to_dataframe
from apt_evap.detection.detector_map import DetectorMap
from apt_evap.detection.distortion import DistortionGrid
from apt_evap.detection.strays import keep_strays, known_strays, strays_of
from apt_evap.detection.timing import mass_to_charge
from apt_evap.warnings import DataWarning, warn

if TYPE_CHECKING:
    import pandas


class Outcome(IntEnum):
    """Result of the flight of a simulated ion."""

    HIT = 0
    """The ion hit the detector."""
    MISSED = 1
    """The ion missed the detector."""
    NEVER_LEFT = 2
    """The ion never left the specimen."""
    OUTSIDE = 3
    """The ion does not arrive in the field of view of the flights, see `FlightSettings`; it may not have been flown."""


class MassRanges(Protocol):
    """What packages that need no spectra use of `Ranges` of mass: the species of every ion."""

    @property
    def species_names(self) -> tuple[str, ...]:
        """Names of the species, each once."""
        ...

    def charges(self, hits: Hits, element: str) -> Integers:
        """Charge of every ion of an element [e], shape (n,); 0 for others."""
        ...

    def species(self, hits: Hits) -> Integers:
        """Index of every ion into `species_names`, shape (n,); -1 for an ion in no range."""
        ...

    def labels(self, hits: Hits, outside: str = "X") -> NDArray[np.str_]:
        """Name of the species of every ion, shape (n,), `outside` for an ion in no range."""
        ...


_FLOAT = ("x", "y", "time_of_flight", "voltage", "pulse_voltage", "mass_to_charge", "positions")
_INTEGER = {
    "pulses": np.uint32,
    "multiplicity": np.uint32,
    "pulse_id": np.int64,
    "site": np.int64,
    "ion": np.int64,
    "outcome": np.int8,
}
_COLUMNS = (*_FLOAT, *_INTEGER)


@dataclass(frozen=True, kw_only=True, eq=False, repr=False)
class Hits:
    """Ions as NumPy columns of equal length n; a missing column is None.

    Floating point columns stay float32, and are converted to float64 otherwise. Arrays are not copied if their type and
    memory order allow it.

    Parameters
    ----------
    x, y : array_like, optional
        Detector coordinates [mm], shape (n,).
    time_of_flight : array_like, optional
        Time of flight [ns], shape (n,).
    voltage, pulse_voltage : array_like, optional
        DC voltage and height of the voltage pulse [V], shape (n,).
    mass_to_charge : array_like, optional
        Mass over charge state [Da], shape (n,).
    positions : array_like, optional
        Reconstructed positions of measured ions, or start positions of simulated ions [nm], shape (n, 3).
    pulses : array_like, optional
        Number of pulses since the last pulse with an ion, shape (n,).
    multiplicity : array_like, optional
        Number of ions in the pulse of each ion, shape (n,).
    pulse_id : array_like, optional
        Number of the pulse, equal for all its ions, shape (n,).
    site : array_like, optional
        Index of the atom in the specimen, shape (n,).
    ion : array_like, optional
        Number of the ion in the sequence of evaporation, shape (n,).
    outcome : array_like, optional
        `Outcome` of each ion, shape (n,); None for measured ions.
    extra : dict, optional
        Further columns by name, as stored in a file: arrays of any type, shape (n,) or (n, k). Selections keep them.
    units : dict, optional
        Units of the further columns by name.
    source : str
        File name, or origin of the ions.
    ranges : Ranges, optional
        Ranges of mass that belong to the ions, such as for `spectrum`. Selections keep them.
    extent : tuple of float, optional
        Area of the detector of a run: x_min, x_max, y_min, y_max [mm]. None for measured ions, for a selection of the
        ions, and for ions with changed coordinates (use ``extent=None`` with the new x and y in `dataclasses.replace`).

    Raises
    ------
    ValueError
        If there is no column, a column has the wrong shape or type, lengths differ, or an outcome is unknown.

    Examples
    --------
    >>> hits = ae.Hits(x=[1.0, -2.0, 12.0], y=[0.5, 3.0, 5.0], mass_to_charge=[29.0, 58.0, 29.1])
    >>> hits
    <Hits: 3 ions, 3 detected; x, y, mass_to_charge>
    >>> hits.window(mass_to_charge=(28, 30)).within_circle(10).x  # mm
    array([1.])
    """

    x: Column = None
    y: Column = None
    time_of_flight: Column = None
    voltage: Column = None
    pulse_voltage: Column = None
    mass_to_charge: Column = None
    positions: Column = None
    pulses: Column = None
    multiplicity: Column = None
    pulse_id: Column = None
    site: Column = None
    ion: Column = None
    outcome: Column = None
    extra: dict = field(default_factory=dict)
    units: dict = field(default_factory=dict)
    source: str = ""
    ranges: MassRanges | None = None
    extent: tuple[float, float, float, float] | None = None

    def __post_init__(self):
        check_itself(self)

    def _check(self):
        values = {name: _column(name, getattr(self, name)) for name in self.columns}
        lengths = {name: len(column) for name, column in values.items()}
        for name in ("extra", "units"):
            mapping = {} if getattr(self, name) is None else getattr(self, name)
            check_kind(mapping, name, Mapping, "a mapping by name of the column")
            for key in mapping:
                check_kind(key, f"a name in {name}", str, "text")
            values[name] = dict(mapping)
        values["extra"] = {name: _extra(name, value) for name, value in values["extra"].items()}
        check_kind(self.source, "source", str, "text")
        if self.ranges is not None:
            check_kind(self.ranges, "ranges", "species", "Ranges, such as ae.io.read_ranges(path)")
        if self.extent is not None:
            check_array(self.extent, "extent", (4,))
        lengths.update((name, len(column)) for name, column in values["extra"].items())
        if not lengths:
            raise ValueError("Hits needs at least one column, got none")
        if len(set(lengths.values())) > 1:
            pairs = ", ".join(f"{name} {length}" for name, length in lengths.items())
            raise ValueError(f"the columns of Hits must have equal lengths, got {pairs}")
        if self.outcome is not None and len(values["outcome"]):
            low, high = values["outcome"].min(), values["outcome"].max()
            if low < min(Outcome) or high > max(Outcome):
                raise ValueError(f"outcome must be Outcomes, {min(Outcome)} to {max(Outcome)}, got {low} to {high}")
        return values

    @property
    def columns(self) -> tuple[str, ...]:
        """Names of the existing columns without those in `extra`, tuple of str."""
        return tuple(name for name in _COLUMNS if getattr(self, name) is not None)

    @property
    def total_voltage(self) -> Floats:
        """Voltage at the time of the evaporation, with the pulse [V], shape (n,)."""
        (voltage,) = self.require("voltage")
        return voltage if self.pulse_voltage is None else voltage + self.pulse_voltage

    def require(self, *names: str) -> tuple[NDArray[Any], ...]:
        """Return columns by name; an error names a missing one.

        Parameters
        ----------
        *names : str
            Names of columns.

        Returns
        -------
        tuple of ndarray

        Raises
        ------
        ValueError
            Names the missing column and the source.
        """
        for name in names:
            if name not in _FLOAT and name not in _INTEGER:
                hint = did_you_mean(name, _COLUMNS)
                raise ValueError(f"Hits has no column {short_text(name)}{hint}; its columns are {', '.join(_COLUMNS)}")
            if getattr(self, name) is None:
                raise ValueError(
                    f"{self.source or 'these hits'} has no column {name!r}, only {', '.join(self.columns)}"
                )
        return tuple(getattr(self, name) for name in names)

    @property
    def detected(self) -> Booleans:
        """Mask of the ions with an outcome of HIT and finite detector coordinates, bool of shape (n,).

        Missing columns are ignored: measured ions have no outcome, and those of a .pos file no detector coordinates.
        Measured ions far outside the field of view are strays, and not detected. The field of view is found from the
        density of the ions; an `extent` given with the ions is kept, so that none of them is a stray.

        Warns
        -----
        DataWarning
            If there are strays, once for the same coordinates: their number and places.
        """
        mask = np.ones(len(self), bool) if self.outcome is None else self.outcome == Outcome.HIT
        for column in (self.x, self.y):
            if column is not None:
                mask &= np.isfinite(column)
        if self._may_have_strays and (strays := strays_of(self.x, self.y, self.source)) is not None:
            mask &= ~strays
        return mask

    @property
    def _may_have_strays(self):
        return self.outcome is None and self.extent is None and self.x is not None and self.y is not None

    @property
    def counts(self) -> dict[Outcome, int]:
        """Number of ions with each `Outcome`, dict; measured ions (no outcome) count as HIT."""
        if self.outcome is None:
            return {outcome: len(self) if outcome == Outcome.HIT else 0 for outcome in Outcome}
        return {outcome: int(np.count_nonzero(self.outcome == outcome)) for outcome in Outcome}

    def map(self, bins: int = 256, **options: Any) -> DetectorMap:
        """Count the detected ions on the detector.

        Parameters
        ----------
        bins : int
            Number of bins along the longer side.
        **options
            Passed to `DetectorMap.from_hits`.

        Returns
        -------
        DetectorMap
        """
        return DetectorMap.from_hits(self, bins=bins, **options)

    def to_dataframe(self, ranges: MassRanges | None = None) -> pandas.DataFrame:
        """Return the ions as a pandas DataFrame; needs pandas.

        Parameters
        ----------
        ranges : Ranges, optional
            Ranges of mass, for a column `species` with names, "" for an ion in no range.

        Returns
        -------
        pandas.DataFrame
            One row per ion; positions become position_x, position_y, position_z; the columns of `extra` follow.
            ``attrs`` contains `source` and `units`.
        """
        names = [name for name in self.columns if name != "positions"]
        columns = {name: getattr(self, name) for name in names}
        if self.positions is not None:
            columns |= dict(zip(("position_x", "position_y", "position_z"), self.positions.T, strict=True))
        if ranges is not None:
            columns["species"] = check_kind(ranges, "ranges", "labels", "Ranges").labels(self, "")
        return to_dataframe(columns | self.extra, source=self.source, units=self.units)

    def with_masses(self, distance: float, time_zero: float = 0.0) -> Hits:
        """The ions with m/n from their times of flight and total voltages, see `mass_to_charge`.

        Parameters
        ----------
        distance : float
            Distance from the apex to the detector [mm].
        time_zero : float
            Time that is subtracted from the times of flight [ns].

        Returns
        -------
        Hits

        Raises
        ------
        ValueError
            If a column is missing, or a number is outside its range.
        """
        time, _, x, y = self.require("time_of_flight", "voltage", "x", "y")
        time_zero = check_number(time_zero, "time_zero", unit="ns")
        return replace(self, mass_to_charge=mass_to_charge(self.total_voltage, time - time_zero, x, y, distance))

    def correlation(self) -> Correlation:
        """Pairs of detected ions of one pulse, and the numbers of pulses with one, two and more ions.

        Returns
        -------
        Correlation

        Raises
        ------
        ValueError
            If there is no mass_to_charge or no pulse_id, or there are too many pairs.

        Examples
        --------
        >>> hits = ae.Hits(mass_to_charge=[14.0, 28.0, 27.0], pulse_id=[1, 1, 2])
        >>> hits.correlation()
        <Correlation: 1 pairs, 66.7% of the ions in pulses with others>
        """
        mass, pulse = self.require("mass_to_charge", "pulse_id")
        with np.errstate(invalid="ignore"):
            rows = self.detected & (mass > 0) & np.isfinite(mass)
        return correlate(mass[rows], pulse[rows])

    def within_circle(self, radius: float, centre: ArrayLike = (0.0, 0.0)) -> Hits:
        """Select the detected ions within a circle on the detector.

        Parameters
        ----------
        radius : float
            Radius of the circle [mm]; the rim is included.
        centre : array_like
            Centre of the circle [mm], shape (2,).

        Returns
        -------
        Hits
            With unchanged pulse_id and multiplicity.

        Raises
        ------
        ValueError
            If there are no detector coordinates, or the radius or centre is invalid.
        """
        x, y = self.require("x", "y")
        radius = check_number(radius, "radius", above=0, unit="mm")
        centre = check_array(centre, "centre", (2,))
        with np.errstate(over="ignore", invalid="ignore"):
            distance = np.hypot(x - centre[0], y - centre[1])
        return self[self.detected & (distance <= radius)]

    def undistorted(self, grid: DistortionGrid, *, dither_seed: int = 0) -> Hits:
        """Remove the distortion of an instrument, such as a reflectron, by its calibration grid.

        Quantised coordinates are first moved at random within one quantisation step, because their steps would have
        different widths afterwards, and alias into stripes in every map.

        Parameters
        ----------
        grid : DistortionGrid
            The grid of this instrument, see `read_grid`.
        dither_seed : int
            Seed of the random moves.

        Returns
        -------
        Hits
            All ions; x and y are NaN outside the grid, so that these ions are not `detected`.

        Raises
        ------
        ValueError
            If there are no detector coordinates, the grid is not a DistortionGrid, or no ion is inside it.

        Warns
        -----
        DataWarning
            If ions are outside the grid; the text contains their number.
        """
        x, y = (values.astype(np.float64) for values in self.require("x", "y"))
        check_kind(grid, "grid", DistortionGrid, "a DistortionGrid, such as read_grid('grid.csv')")
        dither_seed = check_seed(dither_seed, "dither_seed")
        detected = self.detected
        if detected.any() and (steps := find_quantisations(x[detected], y[detected])) is not None:
            random = np.random.default_rng(dither_seed)
            x, y = (
                values + step.spacing * (random.random(len(values)) - 0.5)
                for values, step in zip((x, y), steps, strict=True)
            )
        x, y = grid.undistorted(x, y)
        outside = int(np.count_nonzero(detected & np.isnan(x)))
        if outside and outside == np.count_nonzero(detected):
            raise ValueError(f"grid must contain the ions, got all {outside:,} of them outside {grid!r}")
        if outside:
            warn(
                f"{outside:,} of {np.count_nonzero(detected):,} ions are outside the calibration grid: they have no "
                "undistorted place",
                DataWarning,
            )
        return replace(self, x=x, y=y, extent=None)

    def window(self, **bounds: tuple[float | None, float | None]) -> Hits:
        """Select the ions whose columns are within bounds: ``hits.window(voltage=(4e3, 5e3), multiplicity=(2, None))``.

        Parameters
        ----------
        **bounds
            (low, high) for any column with one value per ion, also of `extra`, in its unit: low <= value < high, None
            for no bound. ``ion`` is the row number if there is no such column (measured ions). Adjacent windows share
            no ion; NaN is in no window.

        Returns
        -------
        Hits
            With unchanged pulse_id and multiplicity.

        Raises
        ------
        ValueError
            If a column is missing or has several values per ion, or if its bounds are not two numbers in increasing
            order.
        """
        selection = np.ones(len(self), bool)
        for name, limits in bounds.items():
            if name in self.extra:
                values = self.extra[name]
            elif name == "ion" and self.ion is None:
                values = np.arange(len(self))
            else:
                (values,) = self.require(name)
            if values.ndim > 1 or values.dtype.kind not in "biuf":
                raise ValueError(f"{name} must have one number per ion for a selection, got shape {values.shape}")
            low, high = _bounds(limits, name)
            selection &= (values >= low) & (values < high)
        return self[selection]

    def __len__(self) -> int:
        for name in _COLUMNS:
            if (column := getattr(self, name)) is not None:
                return len(column)
        return len(next(iter(self.extra.values())))

    def __getitem__(self, selection: slice | ArrayLike) -> Hits:
        """Return the selected ions as `Hits`; takes a slice, a mask, indices or one index."""
        if not isinstance(selection, slice):
            index = np.asarray(without_mask(selection, "a selection of Hits", bool))
            if index.size == 0 and index.dtype == float:
                index = index.astype(np.intp)
            if index.ndim > 1 or index.dtype.kind not in "biu":
                raise ValueError(f"a selection of Hits must be a slice, a mask or indices, got {short_text(selection)}")
            if index.dtype == bool:
                if index.shape != (len(self),):
                    raise ValueError(f"the mask must have shape ({len(self)},), got {index.shape}")
                index = np.flatnonzero(index)
            selection = np.atleast_1d(index)
        columns = {name: getattr(self, name)[selection] for name in self.columns}
        extra = {name: values[selection] for name, values in self.extra.items()}
        selected = Hits(**columns, extra=extra, units=self.units, source=self.source, ranges=self.ranges)
        if self._may_have_strays and (known := known_strays(self.x, self.y))[0]:
            # a part of the ions has the field of view of all
            keep_strays(selected.x, selected.y, None if known[1] is None else known[1][selection])
        return selected

    _repr_html_ = as_table

    def __repr__(self) -> str:
        detected = np.count_nonzero(self.detected)
        source = f" from {self.source!r}" if self.source else ""
        return f"<Hits: {len(self):,} ions, {detected:,} detected{source}; {', '.join([*self.columns, *self.extra])}>"


def _column(name, value):
    """Validate one column and convert it to its type."""
    if name in _INTEGER:
        if isinstance(value, np.ndarray) and value.ndim == 1 and value.dtype == _INTEGER[name]:
            value = without_mask(value, name, value.dtype)
            return np.ascontiguousarray(value)  # no conversion needed
        return check_array(value, name, ("n",), dtype=_INTEGER[name])
    dtype = getattr(value, "dtype", None)
    single = dtype is not None and dtype.kind == "f" and dtype.itemsize == 4
    shape = ("n", 3) if name == "positions" else ("n",)
    return check_array(value, name, shape, dtype=np.float32 if single else np.float64, finite=False)


def _extra(name, value):
    """Validate one of the further columns."""
    column = np.asarray(without_mask(value, f"extra[{name!r}]", getattr(value, "dtype", np.float64)))
    if column.ndim not in (1, 2) or column.dtype == object:
        raise ValueError(f"extra[{name!r}] must be an array of shape (n,) or (n, k), got {short_text(value)}")
    return column


def _bounds(limits, name):
    """Return two bounds, infinite for None."""
    if not isinstance(limits, str) and np.iterable(limits) and len(pair := tuple(limits)) == 2:
        low = -np.inf if pair[0] is None else pair[0]
        high = np.inf if pair[1] is None else pair[1]
        if isinstance(low, Real) and isinstance(high, Real) and low <= high:
            return low, high
    raise ValueError(
        f"{name} must have two bounds (low, high) with low <= high, None for no bound, got {short_text(limits)}"
    )
