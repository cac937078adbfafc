"""The lens in front of the specimen of a run: what the free specimen of the simulation becomes in an instrument."""

import math
from collections.abc import Mapping
from functools import cached_property
from typing import Any, NamedTuple, Protocol

import numpy as np
import scipy
from numpy.typing import ArrayLike

from apt_evap._common.codec import checked, part, settings, to_plain
from apt_evap._common.types import Floats, Integers
from apt_evap._common.validation import check_array, check_kind
from apt_evap.detection.detector import Detector
from apt_evap.detection.microscope.conductors import simulated_flank
from apt_evap.detection.microscope.lens import Lens
from apt_evap.detection.microscope.local_electrode import LensProjection, LocalElectrode
from apt_evap.units import FLIGHT_TIME, NM_PER_MM

_FAR = 1e9  # distance and aperture of an electrode without effect on the specimen: 1 m [nm]
_FAR_ANGLE = math.radians(75)
_BESIDE = 90.0  # degrees: an ion that flies away from the detector
_STEP = 0.05  # relative change of the radius, or of the length in radii, from stage to stage
_MOST_STAGES = 16
_SHORTEST = 0.05  # of the radius: a shank that is used up
_AWAY = 2.0  # length of a stereographic direction that misses every detector
_HEIGHT = 0.6  # nearest neighbour distances at which an ion starts, see `RunLens`
_PROBE = np.radians([20.0])  # the share by which the height changes an angle depends on it by 2 % of itself
_COLUMNS = 11  # of a stage
_DIGITS = 10  # of what is stored: the last digits of a solution depend on the library of linear algebra


class RadiusHistory(NamedTuple):
    """Radius and apex of the cap during a run, each of shape (k,)."""

    ions: Integers
    """Number of evaporated ions."""
    radii: Floats
    """Radius of the cap [nm]."""
    apexes: Floats
    """Position of the apex along the axis [nm]."""


# Stage of a specimen for the widest field of view: a flat cap, and a shank that is used up. The angle of free flights
# that arrive at 15 to 30 degrees increases with both, by 1.0 to 2.3 degrees from 0.85 to 1.2 R and from a new shank.
_FLATTENED = 1.25
_MARGIN = 1.0  # degrees


def _stages(stages, name):
    rows = check_array(stages, name, ("n", _COLUMNS))
    return tuple(tuple(row) for row in rows.tolist())


@settings
class RunLens:
    """Lens in front of the specimen of a run.

    A simulated specimen is in free space and has a short shank. Its ions leave at the angle theta on the cap and
    fly at the angle theta_free. In the instrument they leave at the same theta and fly at theta'. Both functions follow
    from boundary elements, so that theta'(theta_free) needs no new flights. Azimuths do not change. The place of an ion
    on the crystal, the energy that it needs there, and its field are those of the run.

    Notes
    -----
    The radius of the cap and the length of the shank change during a run. The free specimen is solved at several
    stages; between them the results are interpolated.

    An ion starts at its atom, at a potential some volts below that of the smooth cap, as if at rest above it. This
    matters for the small radii of simulations: a height h changes theta_free by the share 0.12 h/R and theta' by 0.40
    h/R (shank of 5 degrees). h is 0.6 nearest neighbour distances, 0.15 nm for nickel, from flights through atoms and
    boundary elements (``articles/microscope``).

    Examples
    --------
    >>> run = ae.Simulation(ae.Tip("Ni", apex_radius=2.0, axis=(1, 1, 1)), seed=1).run(100)
    >>> real = run.at_evaporation_field(ae.detection.LocalElectrode.preset("local electrode"))
    >>> real.lens.radii([0, 99]).round(1)  # nm
    array([1.7, 1.3])
    """

    lens: LocalElectrode = part("The lens of the instrument.", LocalElectrode)
    stages: tuple[tuple[float, ...], ...] = checked(
        "Of each stage the number of ions, the radius of the cap [nm], the largest angle on it that passes the "
        "electrode [degrees], the factor of the angles for the height of the start, and of the free specimen the "
        "field factor and the coefficients of `Lens`.",
        "sequence of rows",
        _stages,
    )

    @classmethod
    def of(
        cls, lens: LocalElectrode, tip: Mapping[str, Any], history: RadiusHistory, distance: float = 0.0
    ) -> "RunLens":
        """Put a lens in front of the specimen of a run.

        Parameters
        ----------
        lens : LocalElectrode
            The lens.
        tip : mapping
            Settings of the tip of the run.
        history : RadiusHistory
            The cap during the run.
        distance : float
            Nearest neighbour distance of the crystal [nm]; 0 for ions that start on the smooth cap.

        Raises
        ------
        ValueError
            If the specimen is not a cap on a shank, or its cap is not known.
        """
        if tip.get("apex_radius") is None:
            raise ValueError("lens needs the shape of the free specimen, which a tip made from positions does not have")
        known = np.isfinite(history.radii)
        if not known.any():
            raise ValueError("lens needs the radius of the cap, which this run does not contain: too few surface atoms")
        ions, radii, apexes = (np.asarray(column, float)[known] for column in history)
        change = max(float(np.log(radii.max() / radii.min())), float(np.ptp(apexes) / radii.min()))
        count = max(1, min(1 + math.ceil(change / _STEP), _MOST_STAGES, len(ions) // 2))
        at = np.linspace(ions[0], ions[-1], count)
        rows = [
            (ion, radius, *_behind(lens, radius, _HEIGHT * distance), *_free(tip, radius, apex, _HEIGHT * distance))
            for ion, radius, apex in zip(at, _smooth(at, ions, radii), _smooth(at, ions, apexes), strict=True)
        ]
        return cls(lens, tuple(tuple(float(f"{value:.{_DIGITS}g}") for value in row) for row in rows))

    def radii(self, ions: ArrayLike) -> Floats:
        """Radius of the cap when these ions leave [nm], shape (n,)."""
        return self._at(ions, slice(1, 2))[:, 0]

    def rim(self, voltage: float, flight_length: float) -> float:
        """Radius of the image that the electrode leaves [mm], on a plane at this flight length [mm]; the least one."""
        angles, radii = self._table[:, 2], self._table[:, 1]
        return float(np.nanmin(self.lens.distance_from_axis(angles, radii, voltage, flight_length)))

    def lens_settings(self) -> dict[str, Any]:
        """Settings of the lens in plain types, those that differ from the defaults."""
        return to_plain(self.lens, short=True)

    def figures(self, ions: ArrayLike) -> dict[str, Floats]:
        """Radius of the cap [nm], field factor and compression when these ions leave, each of shape (n,)."""
        radii = self.radii(ions)
        return {
            "radius": radii,
            "field_factor": self.lens.field_factor(radii),
            "compression": self.lens.compression(radii),
        }

    def constants(self, voltages: Floats, flight_length: float) -> dict[str, Any]:
        """Constants of a reconstruction that follow from the lens: itself, and the radius of the image [mm]."""
        return {"lens": self.lens, "rim": self.rim(float(np.min(voltages)), flight_length)}

    def check_field_factor(self, field_factor: float) -> None:
        """Raise ValueError: the field factor is that of the lens."""
        raise ValueError(f"field_factor follows from the lens, got field_factor={field_factor:g} and a lens")

    def voltages(self, model: Floats, ions: ArrayLike, field: float) -> Floats:
        """Voltages of the instrument.

        Parameters
        ----------
        model : ndarray
            Voltages of the simulated specimen [V], shape (n,).
        ions : array_like
            Numbers of the ions, shape (n,).
        field : float
            Operating field [V/nm].

        Returns
        -------
        ndarray
            V = k_f(R) F R [V], shape (n,), in the mean over the ions. Their fluctuations are those of the model, after
            division by the field factor of the free specimen, which is solved for each stage.
        """
        radii, factors = self._at(ions, slice(1, 2))[:, 0], self._at(ions, slice(4, 5))[:, 0]
        ratio = model / factors
        return field * self.lens.field_factor(radii) * ratio / np.mean(ratio / radii) if len(ratio) else ratio

    def seen(
        self,
        directions: Floats,
        times: Floats,
        ions: ArrayLike,
        masses: Floats,
        charges: Integers,
        model: Floats,
        voltages: Floats,
        flight_length: float,
    ) -> tuple[Floats, Floats]:
        r"""Directions and times of flights in the instrument.

        Parameters
        ----------
        directions : ndarray
            Stereographic directions of the flights of the free specimen, shape (n, 2); NaN for ions that never left.
        times : ndarray
            Times of these flights to a plane at the flight length, at the voltages `model` [ns], shape (n,).
        ions : array_like
            Numbers of the ions, shape (n,).
        masses, charges : array_like
            Of each ion in flight [Da], [e], shape (n,).
        model, voltages : ndarray
            Voltage of the free specimen, and voltage between specimen and electrode in the instrument [V], shape (n,).
        flight_length : float
            Distance of the plane of the detector [mm].

        Returns
        -------
        directions : ndarray
            Stereographic directions of the hits on the plane, seen from the apex, shape (n, 2). Ions that the
            electrode stops, or the detector turns back, point away from it.
        times : ndarray
            Times of flight to the plane [ns], shape (n,); NaN for these ions.

        Notes
        -----
        An ion starts at its atom, some volts below the potential of the smooth cap, perhaps with an energy of its own.
        Both change its time by a share that is the larger, the smaller the voltage is. With the times of smooth
        conductors :math:`t_\mathrm{free}` and :math:`t_\mathrm{lens}`,

        .. math::

           t = t_\mathrm{lens} \left( 1 + \frac{V_\mathrm{model}}{V}
               \Bigl( \frac{t_\mathrm{simulated}}{t_\mathrm{free}} - 1 \Bigr) \right) .
        """
        lengths = np.hypot(*directions.T)
        free = np.degrees(2 * np.arctan(lengths))
        stage = self._at(ions, slice(1, _COLUMNS))
        ahead = free < _BESIDE
        angles = LensProjection(stage[:, 4:7]).cap_angles(np.where(ahead, free, 0.0))
        angles = np.where(ahead & (angles <= stage[:, 1]), angles, np.nan)
        passes = np.isfinite(angles)
        angles, radii = np.where(passes, angles, 0.0), stage[:, 0]
        distances = stage[:, 2] * self.lens.distance_from_axis(angles, radii, voltages, flight_length)
        passes &= np.isfinite(distances)
        square = np.radians(angles) ** 2
        delays = stage[:, 7] + square * (stage[:, 8] + square * stage[:, 9])
        path = flight_length * NM_PER_MM / np.cos(np.radians(np.where(passes, free, 0.0))) + delays
        smooth = FLIGHT_TIME * np.sqrt(masses / (charges * model)) * path / math.sqrt(2)
        excess = np.where(passes, times / smooth - 1, 0.0) * model / voltages
        times = self.lens.flight_time(masses, charges, voltages, flight_length, radii, angles) * (1 + excess)
        seen = np.where(passes, np.tan(np.arctan(distances / flight_length) / 2), _AWAY)
        stretch = np.divide(seen, lengths, out=np.zeros_like(seen), where=lengths > 0)
        stretch[np.isnan(lengths)] = np.nan
        return directions * stretch[:, None], np.where(passes, times, np.nan)

    @cached_property
    def _table(self):
        return np.array(self.stages)

    def _at(self, ions, columns):
        """Columns of the stages, interpolated for each ion, shape (n, columns)."""
        at, rows = self._table[:, 0], self._table[:, columns]
        if len(rows) == 1:
            return np.broadcast_to(rows, (len(np.asarray(ions)), rows.shape[1]))
        place = np.interp(ions, at, np.arange(len(at)))
        first = np.minimum(place.astype(np.int64), len(at) - 2)
        share = (place - first)[:, None]
        return rows[first] * (1 - share) + rows[first + 1] * share


class ShapedSpecimen(Protocol):
    """What the field of view needs of a `Tip`."""

    @property
    def settings(self) -> Mapping[str, Any]:
        """Its settings, in plain types."""
        ...

    @property
    def nearest_neighbour_distance(self) -> float:
        """Distance between nearest neighbours [nm]."""
        ...


def field_of_view(lens: LocalElectrode, tip: ShapedSpecimen, detector: Detector) -> float:
    """Polar angle of the simulated flights that covers a detector behind a lens, for `FlightSettings`.

    Parameters
    ----------
    lens : LocalElectrode
        The lens. It has no potential of the detector, whose influence depends on the voltages.
    tip : Tip
        The specimen: a cap on a shank.
    detector : Detector
        The detector.

    Returns
    -------
    float
        Half the opening angle [degrees], at most 90, with a margin of 1 degree for changes of the cap during the run.

    Raises
    ------
    ValueError
        If the specimen is not a cap on a shank, or the lens has a potential of the detector.

    Examples
    --------
    >>> lens = ae.detection.LocalElectrode.preset("local electrode")
    >>> tip = ae.Tip("Ni", apex_radius=2.0, axis=(1, 1, 1))
    >>> detector = ae.Detector(distance=90.0, width=45.0)
    >>> angle = ae.detection.field_of_view(lens, tip, detector)
    >>> print(f"{angle:.0f} degrees for {detector.half_angle:.0f} degrees behind the lens")
    32 degrees for 19 degrees behind the lens
    """
    check_kind(lens, "lens", LocalElectrode, "a LocalElectrode")
    check_kind(tip, "tip", "phase_at", "a Tip")
    check_kind(detector, "detector", Detector, "a Detector")
    if lens.detector_potential:
        raise ValueError(
            f"lens has the detector_potential {lens.detector_potential:g} V, whose influence depends on the voltages: "
            "give the field of view as a number [degrees]"
        )
    radius = tip.settings.get("apex_radius")
    history = RadiusHistory(np.arange(2), np.full(2, _FLATTENED * (radius or np.nan)), np.zeros(2))
    stages = RunLens.of(lens, tip.settings, history, tip.nearest_neighbour_distance)
    angles = np.linspace(0.0, _BESIDE, 901)[:-1]
    lengths, ones = np.tan(np.radians(angles) / 2), np.ones(len(angles))
    directions, _ = stages.seen(
        np.column_stack([lengths, 0 * lengths]), ones, 0 * ones, ones, ones.astype(int), ones, ones, detector.distance
    )
    arrives = np.degrees(2 * np.arctan(np.hypot(*directions.T))) <= detector.half_angle
    return min(_BESIDE, float(angles[arrives].max()) + _MARGIN)


def _smooth(at, ions, values):
    """Values of the piecewise linear function, with its knots at `at`, that fits values at these ions best."""
    if len(at) == 1:
        return [float(values.mean())]
    knots = np.concatenate([at[:1], at, at[-1:]])
    return scipy.interpolate.make_lsq_spline(ions, values, knots, k=1)(at)


def _behind(lens, radius, height):
    """Largest angle that passes the electrode, and factor of the angles for this height of the start."""
    return lens.widest_angle(radius), _raised(lens.lens(radius), height)


def _raised(lens, height):
    """Angle of a flight from this height over that of a flight from the cap."""
    if height == 0:
        return 1.0
    return float((lens.fly(_PROBE, height=height).angles / lens.fly(_PROBE).angles)[0])


def _free(tip, radius, apex, height):
    """Field factor and coefficients of the projection of the simulated specimen at one stage."""
    angle = math.radians(tip["shank_angle"])
    foot = tip["apex_radius"] + tip["shank_length"] * math.sin(angle)
    # the centre of the initial cap is the origin
    centre = max(apex - radius + tip["shank_length"], _SHORTEST * radius)
    flank = simulated_flank(radius, angle, centre, foot, tip["base"] == "rounded")
    free = Lens(radius, flank, _FAR, _FAR, _FAR_ANGLE)
    projection, delays = np.split(free.coefficients, 2)
    return free.field_factor, *(projection * _raised(free, height)), *delays
