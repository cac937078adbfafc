"""The instrument: which ions it records, and the columns that it writes for them."""

from collections.abc import Callable
from dataclasses import replace
from enum import IntEnum
from typing import Any, NamedTuple

import numpy as np

from apt_evap._common.codec import checked, number, part, settings, vector
from apt_evap._common.ion_random import IonRandom
from apt_evap._common.types import Floats
from apt_evap._common.validation import check_array, check_choice, check_kind, check_number, check_seed
from apt_evap._core.elementary import arctangent, normal_quantile
from apt_evap.detection.detector import PROJECTIONS
from apt_evap.detection.hits import Hits, Outcome
from apt_evap.detection.timing import Timing

_SEED_STEP = 0x3C6EF372FE94F82B  # other random numbers than those of perturbations, isotopes, charges and pulses
_COLUMNS = 5  # random numbers per ion: efficiency, blur in x and y, energy deficit, delay


class Detection(IntEnum):
    """Outcome of the detection of an ion."""

    RECORDED = 0
    """The ion is recorded."""
    OUTSIDE = 1
    """The ion does not arrive within the field of view."""
    NOT_DETECTED = 2
    """The ion arrives within the field of view, but the detector does not respond to it."""
    DEAD = 3
    """The ion is too close in place and time to an ion of the same pulse that is recorded."""


class Recording(NamedTuple):
    """Ions that an instrument records, and why it does not record the others; each of shape (n,)."""

    recorded: np.ndarray
    """Whether the ion is recorded, bool."""
    detection: np.ndarray
    """`Detection` of each ion, int8."""

    @property
    def counts(self) -> dict[Detection, int]:
        """Number of ions with each `Detection`, dict."""
        return {outcome: int(np.count_nonzero(self.detection == outcome)) for outcome in Detection}

    def __repr__(self) -> str:
        return f"<Recording: {_counted(self)}>"


def _projection(projection, name):
    return projection if callable(projection) else check_choice(projection, name, PROJECTIONS)


@settings
class Instrument:
    """Instrument that records ions: image, efficiency, dead time, resolution and quantisation of its detector.

    It is applied after the simulation (`Run.record`). The effects follow one another: position on the detector, field
    of view, efficiency, dead time, resolution, quantisation. By default only the field of view is limited.

    Notes
    -----
    The random numbers of an ion are a function of the seed and of its number in the sequence of evaporation. An ion is
    therefore detected, or blurred, alike in all selections. Whether it is lost by dead time depends on the ions of its
    pulse.

    The mass-to-charge ratio follows from the measured position and time. For a plane at the distance D, an error of the
    position changes it by the factor (D^2 + r^2) / (D^2 + r'^2), with the true and the measured distances r and r' from
    the centre.

    A dead time with a dead zone is a simple description of a delay-line detector, whose signals of two ions overlap.
    Its limits differ between instruments, and have no default here.

    Examples
    --------
    >>> run = ae.Simulation(ae.Tip("Ni", apex_radius=2.0, axis=(1, 1, 1)), seed=1).run(100)
    >>> instrument = ae.Instrument(distance=50.0, field_of_view=80.0, efficiency=0.5, resolution=0.1)
    >>> run.at_evaporation_field().record(instrument, ae.RollUp(0.2))
    <Hits: 28 ions, 28 detected from 'simulation, RollUp(0.2); 28 recorded, 45 outside, 27 not detected, ...>
    """

    # less than 1 mm or more than 1 km is a wrong unit
    distance: float = number(
        "Distance from the apex to the plane on which straight flights form the image. A reflectron has a shorter "
        "virtual distance than its flight path.",
        default=100.0,
        at_least=1,
        at_most=1e6,
        unit="mm",
    )
    field_of_view: float = number("Diameter of the circular detector.", default=80.0, above=0, at_most=1e6, unit="mm")
    projection: str | Callable[[Any], Any] = checked(
        'Position of an ion at the polar angle theta: "plane" at D tan(theta) from the centre, "equidistant" at D '
        "theta, as for `Detector`. Or a function that maps the positions of straight flights on the plane at "
        "`distance` to positions on the detector, (n, 2) -> (n, 2) [mm], such as the measured map of a reflectron; NaN "
        "for an ion that does not arrive.",
        "str or callable",
        _projection,
        default="plane",
    )
    efficiency: float = number(
        "Fraction of the ions that the detector responds to. Every ion has the same probability.",
        default=1.0,
        above=0,
        at_most=1,
    )
    dead_time: float = number(
        "An ion is lost if it arrives less than this after a recorded ion of the same pulse, and closer than "
        "`dead_zone`.",
        default=0.0,
        at_least=0,
        unit="ns",
    )
    dead_zone: float = number("Distance both in x and in y.", default=0.0, at_least=0, unit="mm")
    resolution: float = number(
        "Standard deviation of the measured position in x and in y.", default=0.0, at_least=0, at_most=1e6, unit="mm"
    )
    quantisation: tuple[float, float] | None = vector(
        "Steps in x and y: measured positions are multiples of them. None for continuous positions.",
        2,
        default=None,
        above=0,
        unit="mm",
    )
    timing: Timing | None = part(
        "Errors of the times of flight, instead of those of the run; None keeps those of the run.", Timing, default=None
    )
    flight_path: float | None = number(
        "Length of the flights if it is not that of straight flights, as in a reflectron: the same for all ions.",
        default=None,
        above=0,
        at_most=1e6,
        unit="mm",
    )

    @classmethod
    def preset(cls, name: str, **changes: Any) -> "Instrument":
        """Instrument by the name of a preset.

        Parameters
        ----------
        name : str
            One of `INSTRUMENT_PRESETS`.
        **changes
            Parameters of `Instrument` that are added or changed.

        Returns
        -------
        Instrument

        Raises
        ------
        ValueError
            If the name is unknown or a parameter is outside its range.
        """
        return cls(**{**INSTRUMENT_PRESETS[check_choice(name, "name", INSTRUMENT_PRESETS)], **changes})

    @property
    def extent(self) -> tuple[float, float, float, float]:
        """Square around the field of view: x_min, x_max, y_min, y_max [mm]."""
        half = self.field_of_view / 2
        return -half, half, -half, half

    def record(self, hits: Hits, distance: float | None = None, *, seed: int = 0) -> Recording:
        """Determine which ions are recorded, and why the others are not.

        Parameters
        ----------
        hits : Hits
            All n ions of a run in real units, on a plane detector: with the columns x, y, time_of_flight, pulse_id and
            ion. Their `outcome` is not used.
        distance : float, optional
            Distance from the apex to this plane [mm]; that of the instrument by default.
        seed : int
            Seed of the random numbers.

        Returns
        -------
        Recording
            Mask of the recorded ions, and `Detection` of all ions.

        Raises
        ------
        ValueError
            If a column is missing, or an argument is outside its range.
        """
        return self._measured(hits, distance, seed)[0]

    def hits(self, hits: Hits, distance: float | None = None, *, seed: int = 0) -> Hits:
        """Recorded ions, with the columns that the instrument writes.

        Parameters
        ----------
        hits, distance, seed
            As for `record`. Pulses must not decrease from ion to ion.

        Returns
        -------
        Hits
            The recorded ions in the sequence of evaporation: measured positions, times of flight and mass-to-charge
            ratios, and `pulses` and `multiplicity` of the recorded ions. All other columns are those of `hits`. The
            number of ions that are lost is in `source`.

        Raises
        ------
        ValueError
            As for `record`, or if the pulses decrease.
        """
        recording, columns = self._measured(hits, distance, seed)
        recorded = hits[recording.recorded]
        (pulse,) = recorded.require("pulse_id")
        waits = np.diff(pulse, prepend=pulse[:1])
        if len(waits) and waits.min() < 0:
            raise ValueError(f"pulse_id must not decrease from ion to ion, got a step of {waits.min()}")
        begins, counts = np.unique(pulse, return_counts=True)
        return replace(
            recorded,
            **columns,
            pulses=waits.astype(np.uint32),
            multiplicity=counts[np.searchsorted(begins, pulse)].astype(np.uint32),
            outcome=np.full(len(pulse), Outcome.HIT, np.int8),
            source=f"{hits.source}; {_counted(recording)}" if hits.source else _counted(recording),
            extent=self.extent,
        )

    def _measured(self, hits, distance, seed):
        """Recording of all ions, and measured columns of the recorded ones."""
        check_kind(hits, "hits", Hits, "Hits")
        x, y, times, pulse, ion = hits.require("x", "y", "time_of_flight", "pulse_id", "ion")
        distance = self.distance if distance is None else distance
        distance = check_number(distance, "distance", at_least=1, at_most=1e6, unit="mm")
        u = IonRandom((check_seed(seed) + _SEED_STEP) % (1 << 64), ion).uniform(_COLUMNS)
        points = np.column_stack([x, y]).astype(np.float64) * (self.distance / distance)
        places = self.places(points)
        times = self._times(points, times.astype(np.float64) * (self.distance / distance))
        late = np.ones(len(times))
        if self.timing is not None:
            deficits, delays = self.timing.errors(u[:, 3:])
            with np.errstate(divide="ignore", invalid="ignore"):
                late = (times / np.sqrt(1.0 - deficits) + delays) / times
            times = times * late
        squares = places[:, 0] * places[:, 0] + places[:, 1] * places[:, 1]
        # NaN is outside
        inside = np.isfinite(times) & (squares <= (self.field_of_view / 2) ** 2)
        detected = inside & (u[:, 0] < self.efficiency)
        detection = np.where(inside, Detection.NOT_DETECTED, Detection.OUTSIDE).astype(np.int8)
        detection[detected] = Detection.RECORDED
        candidates = np.flatnonzero(detected)
        dead = self._dead(places[candidates], times[candidates], pulse[candidates], ion[candidates])
        detection[candidates[dead]] = Detection.DEAD
        recorded = detection == Detection.RECORDED
        seen = places[recorded]
        if self.resolution > 0:
            seen = seen + self.resolution * normal_quantile(u[recorded, 1:3])
        if self.quantisation is not None:
            seen = np.rint(seen / self.quantisation) * self.quantisation
        columns = {"x": seen[:, 0], "y": seen[:, 1], "time_of_flight": times[recorded]}
        if hits.mass_to_charge is not None:
            factor = late[recorded] * late[recorded]
            if self._straight:
                square = self.distance * self.distance
                factor = factor * (square + squares[recorded]) / (square + (seen * seen).sum(axis=1))
            columns["mass_to_charge"] = hits.mass_to_charge[recorded] * factor
        return Recording(recorded, detection), columns

    @property
    def _straight(self):
        """Whether ions fly straight to a plane, so that their paths have different lengths."""
        return self.projection == "plane" and self.flight_path is None

    def places(self, points: Floats) -> Floats:
        """Positions on the detector of straight flights.

        Parameters
        ----------
        points : ndarray
            Where straight flights cross the plane at `distance` [mm], shape (n, 2); NaN for those that do not.

        Returns
        -------
        ndarray
            True positions [mm], shape (n, 2), also outside the field of view; NaN for ions that do not arrive.
        """
        if self.projection == "plane":
            return points
        places = np.full_like(points, np.nan)
        ahead = np.isfinite(points).all(axis=1)
        if callable(self.projection):
            mapped = check_array(self.projection(points[ahead].copy()), "result of projection", ("n", 2), finite=False)
            if len(mapped) != np.count_nonzero(ahead):
                n = np.count_nonzero(ahead)
                raise ValueError(f"the result of projection must have shape ({n}, 2), got {mapped.shape}")
            places[ahead] = mapped
            return places
        radius = np.sqrt((points[ahead] * points[ahead]).sum(axis=1))
        angle = arctangent(radius / self.distance)
        stretch = np.divide(self.distance * angle, radius, out=np.ones_like(radius), where=radius > 0)
        places[ahead] = points[ahead] * stretch[:, None]
        return places

    def _times(self, points, times):
        """Times of flight [ns] from those of straight flights to the plane at `distance`."""
        if self._straight:
            return times
        length = self.distance if self.flight_path is None else self.flight_path
        across = (points * points).sum(axis=1)
        return times * (length / np.sqrt(self.distance * self.distance + across))

    def _dead(self, places, times, pulse, ion):
        """Mask of the detected ions that are too close to a recorded one of the same pulse, bool (n,)."""
        n = len(times)
        dead = np.zeros(n, bool)
        if self.dead_time == 0 or self.dead_zone == 0 or n < 2:
            return dead
        order = np.lexsort((ion, times, pulse))
        places, times, pulse = places[order], times[order], pulse[order]
        firsts, seconds = [], []
        for lag in range(1, n):
            together = (pulse[lag:] == pulse[:-lag]) & (times[lag:] - times[:-lag] < self.dead_time)
            if not together.any():
                break
            first = np.flatnonzero(together)
            near = (np.abs(places[first + lag] - places[first]) < self.dead_zone).all(axis=1)
            firsts.append(first[near])
            seconds.append(first[near] + lag)
        if firsts:
            first, second = np.concatenate(firsts), np.concatenate(seconds)
            by_arrival = np.argsort(second, kind="stable")
            for earlier, later in zip(first[by_arrival].tolist(), second[by_arrival].tolist(), strict=True):
                dead[order[later]] |= not dead[order[earlier]]
        return dead


INSTRUMENT_PRESETS: dict[str, dict[str, Any]] = {
    "straight, 100 mm": {"distance": 100.0, "field_of_view": 80.0, "efficiency": 0.80},
    "reflectron, 42 mm": {"distance": 42.0, "efficiency": 0.52},
}
"""Parameters of `Instrument` by name.

"straight, 100 mm": distance and diameter of a LEAP 5000 XS (Shaikh et al., arXiv:2509.13744, methods). "reflectron, 42
mm": virtual distance of a LEAP 5000 with reflectron (transformaxes.m of PrzemyslawKlups/posgenpy). Efficiencies of the
5000 XS and 5000 XR: Atom Probe Toolbox (P. Felfer group, APTConfig.m). Other parameters are the defaults.
"""


def _counted(recording):
    """Number of ions of each kind, in words."""
    counts = {outcome.name.lower().replace("_", " "): count for outcome, count in recording.counts.items()}
    return ", ".join(f"{count:,} {name}" for name, count in counts.items())
