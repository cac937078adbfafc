"""The lens of a specimen in front of an electrode, for all radii of its apex."""

import math
from functools import cached_property, lru_cache
from typing import Any, NamedTuple

import numpy as np
import scipy
from numpy.typing import ArrayLike

from apt_evap._common.codec import checked, number, settings
from apt_evap._common.types import Floats
from apt_evap._common.validation import check_array, check_choice, check_number, check_values
from apt_evap.detection.microscope.conductors import measured_flank, straight_flank
from apt_evap.detection.microscope.lens import LAST_ANGLE, Lens
from apt_evap.units import FLIGHT_TIME, NM_PER_MM

SMALLEST, LARGEST = 1.0, 1000.0
"""Radii of the apex that a lens is computed for [nm]."""
_ITERATIONS = 5  # of Newton's method; the ratio of the angles changes by a few per cent only
# cubic through the values at -1, 0, 1 and 2, in powers of the place between 0 and 1; the highest power first
_CUBIC = np.array([[-1, 3, -3, 1], [3, -6, 3, 0], [-2, -3, 6, -1], [0, 6, 0, 0]]) / 6.0
_MIDDLE = np.array([-1, 9, 9, -1]) / 16.0  # the same at 1/2
_EVEN = np.array([0, 2, 4])
# With a profile, octaves are divided until the interpolated field factor and angles agree with those in the middle.
_FACTOR_BOUND, _ANGLE_BOUND = 5e-5, 1e-4
_NARROWEST = 2.0**-8  # octaves: the field factor has a kink where the sphere of the apex passes one of the profile


class LensProjection(NamedTuple):
    """Projection of angles on the cap to angles of the flights behind the electrode."""

    coefficients: Floats
    """Coefficients of theta' / theta in powers of theta^2 [rad], shape (3,) or (n, 3)."""

    def flight_angles(self, angles: ArrayLike) -> Any:
        """Angles of the flights behind the electrode.

        Parameters
        ----------
        angles : float or array_like
            Angles on the cap, seen from its centre, from the axis [degrees], 0 to 50; larger ones give NaN.

        Returns
        -------
        float or ndarray
            [degrees].
        """
        degrees = _numbers(angles, "angles", at_least=0.0, below=180.0)
        theta = np.radians(degrees)
        flown = np.degrees(theta * self._ratio(theta**2))
        return _plain(np.where(degrees <= LAST_ANGLE, flown, np.nan))

    def cap_angles(self, angles: ArrayLike) -> Any:
        """Angles on the cap of flights: the inverse of `flight_angles`.

        Parameters
        ----------
        angles : float or array_like
            Angles of the flights behind the electrode from the axis [degrees].

        Returns
        -------
        float or ndarray
            [degrees], 0 to 50; NaN for flights that come from no such angle.
        """
        flown = np.radians(_numbers(angles, "angles", at_least=0.0, below=180.0))
        last = math.radians(LAST_ANGLE)
        within = flown <= last * self._ratio(last**2) * (1 + 1e-12)
        flown = np.where(within, flown, 0.0)
        zeroth, first, second = np.moveaxis(self.coefficients, -1, 0)
        theta = flown / zeroth
        for _ in range(_ITERATIONS):
            square = theta**2
            slope = zeroth + square * (3 * first + 5 * second * square)
            theta = theta - (theta * self._ratio(square) - flown) / slope
        return _plain(np.where(within, np.degrees(theta), np.nan))

    def _ratio(self, square):
        zeroth, first, second = np.moveaxis(self.coefficients, -1, 0)
        return zeroth + square * (first + square * second)


def _profile(rows, name):
    profile = check_array(rows, name, ("n", 2))
    if len(profile) < 2 or (profile[:, 1] <= 0).any() or (profile[0, 0] < 0) or (np.diff(profile[:, 0]) <= 0).any():
        raise ValueError(
            f"{name} must contain at least two pairs of an increasing distance >= 0 and a radius > 0 [nm], got "
            f"{len(profile)} pairs that begin with {profile[:2].tolist()}"
        )
    if (np.diff(profile[:, 1]) < 0).any():
        raise ValueError(
            f"{name} must have radii that do not decrease, got {profile[:, 1].min():g} nm after a larger one"
        )
    return tuple(tuple(pair) for pair in profile.tolist())


@settings
class LocalElectrode:
    """Lens that a specimen with a shank and an electrode with an aperture form.

    It gives the field factor and the image compression of a specimen as functions of its radius, the radius from the
    voltage, and the paths and times of flights to a detector. All arrays are broadcast; numbers give numbers.

    Notes
    -----
    The conductors have a common axis: a spherical cap with a conical shank, and a cone with an aperture. Their charges
    follow from boundary elements (``boundary_elements.py``), the projection from flights of ions that start at rest
    (``lens.py``). Both are computed when they are first needed, for radii of 1, 2, 4, ... nm, and kept with the object.
    Between these radii, cubic polynomials in the logarithm of the radius interpolate. With a profile, further radii are
    added until the interpolation agrees with the solution. Measured: field factors within 1e-5, for shanks of 30
    degrees and profiles with kinks within 1e-4; angles within 1e-4.

    Equations and limits: :doc:`/microscope`. Electrodes and their influence on field factor and compression: Loi et
    al., Ultramicroscopy 132, 107 (2013).

    Examples
    --------
    >>> lens = ae.detection.LocalElectrode(distance=40e3, aperture=20e3, shank_angle=5.0)
    >>> round(lens.field_factor(50.0), 1), round(lens.compression(50.0), 2)
    (2.6, 1.37)
    >>> round(lens.radius(voltage=5000.0, field=35.0), 1)
    55.4
    """

    # below 10 micrometres the electrode is no longer far from the largest apex
    distance: float = number(
        "Distance from the apex to the plane of the aperture.", at_least=1e4, at_most=1e9, unit="nm"
    )
    aperture: float = number(
        "Radius of the aperture, 1/8 to 10 times the distance.", at_least=1e3, at_most=1e9, unit="nm"
    )
    shank_angle: float = number(
        "Half the opening angle of the shank; with a profile, below it.", at_least=0.1, at_most=30, unit="degrees"
    )
    shank_length: float = number(
        "Length of the shank along its surface; with a profile, below it.",
        default=1e5,
        at_least=1e4,
        at_most=1e9,
        unit="nm",
    )
    electrode_angle: float = number(
        "Half the opening angle of the cone of the electrode, which widens away from the specimen; 90 for a plane.",
        default=75.0,
        at_least=10,
        at_most=90,
        unit="degrees",
    )
    detector_potential: float = number(
        "Voltage between the electrode and the detector; positive if it accelerates the ions.",
        default=0.0,
        at_least=-1e5,
        at_most=1e5,
        unit="V",
    )
    profile: tuple[tuple[float, float], ...] | None = checked(
        "Shank with an angle that changes, from a micrograph: pairs of the distance from the initial apex and the "
        "radius of the shank there. An apex of a given radius is where its sphere touches the profile. Below the "
        "profile follows a cone with `shank_angle`.",
        "sequence of pairs",
        _profile,
        default=None,
        unit="nm",
    )

    def _check(self):
        # measured: through narrower apertures, the few angles that pass do not determine the projection
        if not self.distance / 8 <= self.aperture <= 10 * self.distance:
            raise ValueError(
                f"aperture must be from one eighth to 10 times the distance of {self.distance:g} nm, got "
                f"{self.aperture:g} nm"
            )

    @classmethod
    def preset(cls, name: str, **changes: Any) -> "LocalElectrode":
        """Lens by the name of a preset.

        Parameters
        ----------
        name : str
            One of `ELECTRODE_PRESETS`.
        **changes
            Parameters of `LocalElectrode` that are changed, such as the angle of the shank.

        Returns
        -------
        LocalElectrode

        Raises
        ------
        ValueError
            If the name is unknown or a parameter is outside its range.
        """
        return cls(**{**ELECTRODE_PRESETS[check_choice(name, "name", ELECTRODE_PRESETS)], **changes})

    def lens(self, radius: float, refinement: int = 1) -> Lens:
        """Solve the charges for one radius of the apex, without interpolation.

        Parameters
        ----------
        radius : float
            [nm], 1 to 1000.
        refinement : int
            Factor of the number of panels, for tests of the convergence.

        Returns
        -------
        Lens
        """
        return self._solve(check_number(radius, "radius", at_least=SMALLEST, at_most=LARGEST, unit="nm"), refinement)

    def _solve(self, radius, refinement=1):
        angle = math.radians(self.shank_angle)
        if self.profile is None:
            flank = straight_flank(radius, angle, self.shank_length)
        else:
            flank = measured_flank(radius, np.array(self.profile), angle, self.shank_length)
        distance = self.distance + flank.recession
        return Lens(radius, flank, distance, self.aperture, math.radians(self.electrode_angle), refinement)

    def field_factor(self, radius: ArrayLike) -> Any:
        """Field factor k_f in V = k_f F R, with the field F of the smooth apex.

        Parameters
        ----------
        radius : float or array_like
            Radius of the apex [nm], 1 to 1000.

        Returns
        -------
        float or ndarray
        """
        return _plain(self._table.field_factors(_radii(radius)))

    def compression(self, radius: ArrayLike) -> Any:
        """Image compression xi: the mean of theta / theta' for theta from 5 to 30 degrees.

        Parameters
        ----------
        radius : float or array_like
            Radius of the apex [nm], 1 to 1000.

        Returns
        -------
        float or ndarray
            Angle on the cap divided by the angle of the flight behind the electrode. In this range it changes by about
            2 %; `projection` has the function.
        """
        return _plain(self._table.compressions(_radii(radius)))

    def projection(self, radius: ArrayLike) -> LensProjection:
        """Projection of angles on the cap to angles of flights, and its inverse.

        Parameters
        ----------
        radius : float or array_like
            Radius of the apex [nm], 1 to 1000; or one for each angle that is to be projected.

        Returns
        -------
        LensProjection
            For angles on the cap from 0 to 50 degrees. The electrode stops ions from beyond `widest_angle`.
        """
        return LensProjection(self._table.coefficients(_radii(radius))[..., :3])

    def widest_angle(self, radius: float) -> float:
        """Angle on the cap whose ions touch the rim of the aperture.

        Parameters
        ----------
        radius : float
            Radius of the apex [nm], 1 to 1000.

        Returns
        -------
        float
            [degrees], at most 50.
        """
        return self._table.lens(float(_radii(check_number(radius, "radius", unit="nm")))).widest_angle

    def radius(self, voltage: ArrayLike, field: ArrayLike) -> Any:
        """Radius of the apex from the voltage: the inverse of V = k_f(R) F R.

        Parameters
        ----------
        voltage : float or array_like
            At the top of the pulse [V].
        field : float or array_like
            Field of the smooth apex at which atoms evaporate [V/nm].

        Returns
        -------
        float or ndarray
            [nm].

        Raises
        ------
        ValueError
            If a value is not positive, or the radius is not within 1 to 1000 nm.
        """
        ratio = _numbers(voltage, "voltage", above=0.0) / _numbers(field, "field", above=0.0)
        if ratio.size == 0:
            return ratio
        low, high = (self._table.radius(float(value)) for value in (ratio.min(), ratio.max()))
        if not SMALLEST <= low <= high <= LARGEST:
            raise ValueError(
                f"voltage / field must belong to a radius from {SMALLEST:g} to {LARGEST:g} nm, got ratios from "
                f"{ratio.min():g} to {ratio.max():g} nm"
            )
        # the radius is nearly proportional to the ratio: knots that are 5 % apart suffice (measured: 1e-7)
        radii = np.geomspace(low * 0.999, high * 1.001, 4 + math.ceil(math.log(high / low) / 0.05))
        return _plain(scipy.interpolate.CubicSpline(radii * self._table.field_factors(radii), radii)(ratio))

    def distance_from_axis(
        self, angle: ArrayLike, radius: ArrayLike, voltage: ArrayLike, flight_length: ArrayLike
    ) -> Any:
        """Distance of the hit from the axis on a plane detector.

        Parameters
        ----------
        angle : float or array_like
            Angle of the launch on the cap [degrees], 0 to 50; larger ones give NaN.
        radius : float or array_like
            Radius of the apex [nm].
        voltage : float or array_like
            Voltage between specimen and electrode [V].
        flight_length : float or array_like
            Distance of the detector [mm].

        Returns
        -------
        float or ndarray
            L tan(theta') 2 / (1 + sqrt(1 + U / (V cos(theta')^2))) [mm], with the potential U of the detector; NaN for
            ions that it turns back.
        """
        flown = np.radians(self.projection(radius).flight_angles(angle))
        length = _numbers(flight_length, "flight_length", above=0.0)
        return _plain(length * np.tan(flown) * self._drift(flown, _numbers(voltage, "voltage", above=0.0)))

    def cap_angle(
        self, distance_from_axis: ArrayLike, radius: ArrayLike, voltage: ArrayLike, flight_length: ArrayLike
    ) -> Any:
        """Angle of the launch on the cap from the hit on a plane detector: the inverse of `distance_from_axis`.

        Parameters
        ----------
        distance_from_axis : float or array_like
            Distance of the hit from the axis [mm].
        radius : float or array_like
            Radius of the apex [nm].
        voltage : float or array_like
            Voltage between specimen and electrode [V]; it matters with a potential of the detector only.
        flight_length : float or array_like
            Distance of the detector [mm].

        Returns
        -------
        float or ndarray
            [degrees], 0 to 50; NaN for hits from no such angle.
        """
        ratio = _numbers(distance_from_axis, "distance_from_axis", at_least=0.0)
        ratio = ratio / _numbers(flight_length, "flight_length", above=0.0)
        # in the uniform field k c^2 + s c + k - 1 = 0, with s = r / L, k = U s^2 / (4 V) and c = 1 / tan(theta')
        k = self.detector_potential * ratio**2 / (4 * _numbers(voltage, "voltage", above=0.0))
        with np.errstate(invalid="ignore"):
            root = ratio + np.sqrt(ratio**2 + 4 * k * (1 - k))
        flown = np.arctan2(root, 2 * (1 - k))
        known = np.isfinite(flown)
        angles = self.projection(radius).cap_angles(np.degrees(np.where(known, flown, 0.0)))
        return _plain(np.where(known, angles, np.nan))

    def flight_time(
        self,
        mass: ArrayLike,
        charge: ArrayLike,
        voltage: ArrayLike,
        flight_length: ArrayLike,
        radius: ArrayLike,
        angle: ArrayLike = 0.0,
    ) -> Any:
        """Time of flight from the apex to a plane detector.

        Parameters
        ----------
        mass : float or array_like
            [Da].
        charge : float or array_like
            Charge of the ion [e].
        voltage : float or array_like
            Voltage between specimen and electrode [V].
        flight_length : float or array_like
            Distance of the detector [mm].
        radius : float or array_like
            Radius of the apex [nm].
        angle : float or array_like
            Angle of the launch on the cap [degrees], 0 to 50; larger ones give NaN.

        Returns
        -------
        float or ndarray
            [ns]; NaN for ions that the detector turns back.
        """
        degrees = _numbers(angle, "angle", at_least=0.0, below=180.0)
        coefficients = self._table.coefficients(_radii(radius))
        flown = np.radians(LensProjection(coefficients[..., :3]).flight_angles(degrees))
        square = np.radians(degrees) ** 2
        delay = coefficients[..., 3] + square * (coefficients[..., 4] + square * coefficients[..., 5])
        mass, charge, voltage = (
            _numbers(value, name, above=0.0)
            for value, name in ((mass, "mass"), (charge, "charge"), (voltage, "voltage"))
        )
        length = _numbers(flight_length, "flight_length", above=0.0) * NM_PER_MM
        drift = length / np.cos(flown) * self._drift(flown, voltage) + delay
        return _plain(FLIGHT_TIME * np.sqrt(mass / (charge * voltage)) * drift / math.sqrt(2))

    def potential_along_axis(self, distance: ArrayLike, radius: float, voltage: float = 1.0) -> Any:
        """Potential on the axis, without the potential of the detector.

        Parameters
        ----------
        distance : float or array_like
            Distance from the apex [nm].
        radius : float
            Radius of the apex [nm].
        voltage : float
            Voltage between specimen and electrode [V].

        Returns
        -------
        float or ndarray
            Against the electrode [V].
        """
        return self._along_axis(distance, radius, voltage)[0]

    def field_along_axis(self, distance: ArrayLike, radius: float, voltage: float = 1.0) -> Any:
        """Field on the axis [V/nm]; arguments as of `potential_along_axis`."""
        return self._along_axis(distance, radius, voltage)[1]

    def _along_axis(self, distance, radius, voltage):
        distances = _numbers(distance, "distance", at_least=0.0)
        voltage = check_number(voltage, "voltage", above=0, unit="V")
        lens = self._table.lens(float(_radii(check_number(radius, "radius", unit="nm"))))
        return tuple(_plain(voltage * values.reshape(distances.shape)) for values in lens.along_axis(distances.ravel()))

    def _drift(self, flown, voltage):
        """Factor by which the potential of the detector shortens the drift."""
        with np.errstate(invalid="ignore"):
            return 2 / (1 + np.sqrt(1 + self.detector_potential / (voltage * np.cos(flown) ** 2)))

    @cached_property
    def _table(self):
        return _table_of(self)


@lru_cache(maxsize=16)
def _table_of(setting):
    """Equal lenses share their solutions, for example those that are read from the settings of runs."""
    return _Table(setting)


class _Table:
    """Solutions at radii that are powers of 2, and interpolation between them."""

    def __init__(self, setting: LocalElectrode) -> None:
        self._setting = setting
        self._lenses: dict[float, Lens] = {}
        self._cells: dict[int, list[tuple[float, float]]] = {}
        self._last: Lens | None = None

    def lens(self, radius: float) -> Lens:
        """Solution at one radius; the last one is kept."""
        if self._last is None or self._last.radius != radius:
            self._last = self._setting.lens(radius)
        return self._last

    def field_factors(self, radii: Floats) -> Floats:
        """Field factors, of the shape of the radii [nm]."""
        return self._interpolate(radii, lambda lens: lens.field_factor)

    def coefficients(self, radii: Floats) -> Floats:
        """Coefficients of `Lens`, with the shape of the radii [nm] and 6 columns."""
        return self._interpolate(radii, lambda lens: lens.coefficients)

    def compressions(self, radii: Floats) -> Floats:
        """Image compressions, of the shape of the radii [nm]."""
        return self._interpolate(radii, lambda lens: lens.compression)

    def radius(self, ratio: float) -> float:
        """Radius for a ratio of voltage and field, clipped to slightly more than the table."""
        radius = ratio / 3
        for _ in range(40):  # k_f changes by 15 % when the radius doubles: an error decreases by a factor of 5
            radius = min(max(radius, 0.9 * SMALLEST), 1.1 * LARGEST)
            radius, last = ratio / float(self.field_factors(np.array(radius))), radius
            if abs(radius - last) < 1e-12 * radius:
                break
        return radius

    def _interpolate(self, radii, quantity):
        if radii.size == 0:
            return np.empty((*radii.shape, *np.shape(quantity(self._node(5)))))
        place = np.log2(radii)
        first, last = (math.floor(end) for end in (place.min(), place.max()))
        starts, widths = np.array([cell for octave in range(first, last + 1) for cell in self._cells_of(octave)]).T
        windows = np.array(
            [[quantity(self._node(place)) for place in starts + shift * widths] for shift in range(-1, 3)]
        )
        cubic = np.tensordot(_CUBIC, windows, axes=1)
        powers = widths ** np.arange(3, -1, -1)[:, None]
        cubic /= powers.reshape(*powers.shape, *[1] * (cubic.ndim - 2))
        return scipy.interpolate.PPoly(cubic, np.append(starts, last + 1.0))(place)

    def _cells_of(self, octave):
        """Start and width of the intervals of the interpolation from 2^octave nm on, in octaves."""
        if octave not in self._cells:
            whole = (float(octave), 1.0)
            self._cells[octave] = [whole] if self._setting.profile is None else self._divided(*whole)
        return self._cells[octave]

    def _divided(self, start, width):
        """Parts of an interval in which the interpolation agrees with the solution in the middle."""
        middle, half = self._node(start + width / 2), width / 2
        around = [self._node(start + shift * width) for shift in range(-1, 3)]
        factor, coefficients = (
            sum(weight * value for weight, value in zip(_MIDDLE, values, strict=True))
            for values in ([lens.field_factor for lens in around], [lens.coefficients for lens in around])
        )
        # change of the angle and of the path of a flight with the farthest angle on the cap
        changes = np.abs(coefficients - middle.coefficients).reshape(2, 3) @ math.radians(LAST_ANGLE) ** _EVEN
        apart = abs(factor / middle.field_factor - 1), changes[0] / middle.coefficients[0]
        if width <= _NARROWEST or (apart[0] <= _FACTOR_BOUND and apart[1] <= _ANGLE_BOUND):
            return [(start, width)]
        return [*self._divided(start, half), *self._divided(start + half, half)]

    def _node(self, index):
        if index not in self._lenses:
            self._lenses[index] = self._setting._solve(2.0**index)
        return self._lenses[index]


def _radii(radius):
    radii = _numbers(radius, "radius", above=0.0)
    if radii.size and not SMALLEST <= radii.min() <= radii.max() <= LARGEST:
        wrong = radii.min() if radii.min() < SMALLEST else radii.max()
        raise ValueError(f"radius must be from {SMALLEST:g} to {LARGEST:g} nm, got {wrong:g}")
    return radii


def _numbers(value, name, **bounds):
    """A number or an array of numbers as an array, within bounds of `check_number`."""
    array = check_values(value, name)
    if array.size:
        for extreme in (array.min(), array.max()):
            check_number(float(extreme), name, **bounds)
    return array


def _plain(array):
    """A number instead of an array without axes."""
    return array if np.ndim(array) else float(array)


ELECTRODE_PRESETS: dict[str, dict[str, Any]] = {
    "local electrode": {"distance": 40e3, "aperture": 20e3, "shank_angle": 5.0},
    "plane electrode": {
        "distance": 5e6,
        "aperture": 2.5e6,
        "shank_angle": 5.0,
        "shank_length": 1e6,
        "electrode_angle": 90.0,
    },
}
"""Parameters of `LocalElectrode` by name.

The geometries are generic, because no public source with the dimensions of an instrument was found. "local electrode":
an aperture tens of micrometres in front of the apex. "plane electrode": a straight tomographic atom probe, whose
counter-electrode is a plane with a hole at a distance of millimetres. Angles of the shank belong to the specimen and
should be changed.
"""
