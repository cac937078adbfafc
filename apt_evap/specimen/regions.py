"""Regions of a specimen: where a phase is.

Coordinates are those of the specimen [nm]: the centre of the cap is the origin, z is the axis, and the apex is at
z = apex_radius. A point at the depth t below the apex is (0, 0, apex_radius - t).
"""

from collections.abc import Mapping
from dataclasses import dataclass, fields
from typing import Any, Protocol

import numpy as np

from apt_evap._common.small_matrices import lengths, products
from apt_evap._common.types import Booleans, Floats
from apt_evap._common.validation import check_array, check_choice, check_kind, check_number, short_text

_ON_BOUNDARY = 1e-7  # [nm]: sites on the boundary belong to the region, in spite of rounding
_BISECTIONS = 60  # the position is then exact to the rounding of float64


class Region(Protocol):
    """Interface of a region with a boundary: a class of a user's own needs this method only."""

    def distance(self, points: Floats) -> Floats:
        """Distance from the boundary [nm], negative inside; points (n, 3) [nm] -> (n,)."""
        ...


def _point(value, name):
    return tuple(check_array(value, name, (3,)).tolist())


def _direction(value, name):
    vector = check_array(value, name, (3,))
    if not 1e-6 < float(lengths(vector)) < 1e6:
        raise ValueError(f"{name} must be a direction with a length between 1e-6 and 1e6, got {short_text(value)}")
    return tuple(vector.tolist())


def _unit(direction):
    """Unit vector along a checked direction, which is itself stored as given."""
    vector = np.array(direction)
    return vector / lengths(vector)


def _store(region, **values):
    """Set the checked fields of a frozen region."""
    for name, value in values.items():
        object.__setattr__(region, name, value)


@dataclass(frozen=True)
class Sphere:
    """A ball, such as a precipitate or a bubble.

    Parameters
    ----------
    centre : sequence of float
        [nm], shape (3,).
    radius : float
        [nm].

    Raises
    ------
    ValueError
        If a number is outside its range.
    """

    centre: tuple[float, float, float]
    radius: float

    def __post_init__(self):
        _store(
            self, centre=_point(self.centre, "centre"), radius=check_number(self.radius, "radius", above=0, unit="nm")
        )

    def distance(self, points: Floats) -> Floats:
        """Distance from the boundary [nm], negative inside, shape (n,)."""
        return lengths(points - np.array(self.centre)) - self.radius


@dataclass(frozen=True)
class Ellipsoid:
    """An ellipsoid, such as a platelet or a needle.

    Parameters
    ----------
    centre : sequence of float
        [nm], shape (3,).
    semi_axes : sequence of float
        Half the length of the three axes [nm], shape (3,).
    axis : sequence of float
        Direction of the third axis in the specimen, shape (3,). For another one than +z, the first axis is turned with
        it, along the great circle; this matters only if the first two are unequal.

    Raises
    ------
    ValueError
        If a number is outside its range.
    """

    centre: tuple[float, float, float]
    semi_axes: tuple[float, float, float]
    axis: tuple[float, float, float] = (0.0, 0.0, 1.0)

    def __post_init__(self):
        semi_axes = _point(self.semi_axes, "semi_axes")
        for length in semi_axes:
            check_number(length, "semi_axes", above=0, unit="nm")
        _store(self, centre=_point(self.centre, "centre"), semi_axes=semi_axes, axis=_direction(self.axis, "axis"))

    def _local(self, points):
        """Coordinates along the three axes, shape (n, 3)."""
        along = _unit(self.axis)
        x, y, z = along.tolist()
        sign = -1.0 if z < -0.9 else 1.0
        a = -1.0 / (sign + z)  # as `tangent_frame`
        first = np.array([1 + sign * x * x * a, sign * x * y * a, -sign * x])
        second = np.array([x * y * a, sign + y * y * a, -y])
        step = points - np.array(self.centre)
        return np.stack([products(step, first), products(step, second), products(step, along)], axis=1)

    def contains(self, points: Floats) -> Booleans:
        """Whether points (n, 3) [nm] are inside, bool (n,)."""
        scaled = self._local(points) / (np.array(self.semi_axes) + _ON_BOUNDARY)
        return products(scaled, scaled) <= 1.0

    def distance(self, points: Floats) -> Floats:
        """Distance from the boundary [nm], negative inside, shape (n,).

        From the closest point x_i = a_i^2 y_i / (t + a_i^2), with t from sum_i (x_i / a_i)^2 = 1 by bisection (Eberly,
        Distance from a point to an ellipse, an ellipsoid, or a hyperellipsoid, 2013).
        """
        # a coordinate of 0 has no direction to the boundary
        local = np.maximum(np.abs(self._local(points)), 1e-12)
        squares = np.array(self.semi_axes) ** 2
        least = float(min(self.semi_axes))
        low = np.full(len(local), -(least**2))
        high = low + float(max(self.semi_axes)) * lengths(local) + least**2
        for _ in range(_BISECTIONS):
            t = 0.5 * (low + high)
            ratio = np.array(self.semi_axes) * local / (t[:, None] + squares)
            outside = products(ratio, ratio) > 1.0
            low, high = np.where(outside, t, low), np.where(outside, high, t)
        t = 0.5 * (low + high)
        closest = squares * local / (t[:, None] + squares)
        return np.where(t < 0.0, -1.0, 1.0) * lengths(local - closest)


@dataclass(frozen=True)
class Cylinder:
    """A cylinder, such as a rod or a wire.

    Parameters
    ----------
    centre : sequence of float
        [nm], shape (3,).
    radius : float
        [nm].
    length : float, optional
        Length [nm]; by default without ends.
    axis : sequence of float
        Its direction in the specimen, shape (3,).

    Raises
    ------
    ValueError
        If a number is outside its range.
    """

    centre: tuple[float, float, float]
    radius: float
    length: float | None = None
    axis: tuple[float, float, float] = (0.0, 0.0, 1.0)

    def __post_init__(self):
        length = None if self.length is None else check_number(self.length, "length", above=0, unit="nm")
        _store(
            self,
            centre=_point(self.centre, "centre"),
            radius=check_number(self.radius, "radius", above=0, unit="nm"),
            length=length,
            axis=_direction(self.axis, "axis"),
        )

    def distance(self, points: Floats) -> Floats:
        """Distance from the boundary [nm], negative inside, shape (n,)."""
        step = points - np.array(self.centre)
        axis = _unit(self.axis)
        along = products(step, axis)
        side = lengths(step - along[:, None] * axis) - self.radius
        if self.length is None:
            return side
        end = np.abs(along) - 0.5 * self.length
        beyond = np.sqrt(np.maximum(side, 0.0) ** 2 + np.maximum(end, 0.0) ** 2)
        return np.where((side > 0.0) & (end > 0.0), beyond, np.maximum(side, end))


@dataclass(frozen=True)
class HalfSpace:
    """Everything on one side of a plane, such as the second grain of a bicrystal.

    Parameters
    ----------
    point : sequence of float
        Any point of the plane [nm], shape (3,).
    normal : sequence of float
        Normal of the plane, towards the region, shape (3,).

    Raises
    ------
    ValueError
        If a number is outside its range.
    """

    point: tuple[float, float, float]
    normal: tuple[float, float, float]

    def __post_init__(self):
        _store(self, point=_point(self.point, "point"), normal=_direction(self.normal, "normal"))

    def distance(self, points: Floats) -> Floats:
        """Distance from the boundary [nm], negative inside, shape (n,)."""
        return -products(points - np.array(self.point), _unit(self.normal))


@dataclass(frozen=True)
class Layer:
    """The space between two parallel planes, such as a layer of a multilayer.

    Parameters
    ----------
    lower, upper : float
        Positions of the planes along the normal [nm]. For the default normal they are heights z: the apex is at z =
        apex_radius.
    normal : sequence of float
        Normal of the planes, shape (3,).

    Raises
    ------
    ValueError
        If a number is outside its range, or if `upper` is not above `lower`.
    """

    lower: float
    upper: float
    normal: tuple[float, float, float] = (0.0, 0.0, 1.0)

    def __post_init__(self):
        lower = check_number(self.lower, "lower", unit="nm")
        upper = check_number(self.upper, "upper", above=lower, unit="nm")
        _store(self, lower=lower, upper=upper, normal=_direction(self.normal, "normal"))

    def distance(self, points: Floats) -> Floats:
        """Distance from the boundary [nm], negative inside, shape (n,)."""
        along = products(points, _unit(self.normal))
        return np.maximum(self.lower - along, along - self.upper)


@dataclass(frozen=True)
class CoreShell:
    """The shell around a core: all points outside the core, but at most a thickness away from it.

    Parameters
    ----------
    core : region
        The core, which does not belong to this region; usually the region of another phase.
    thickness : float
        Thickness of the shell [nm].

    Raises
    ------
    ValueError
        If the core has no distance, or the thickness is not positive.
    """

    core: Any
    thickness: float

    def __post_init__(self):
        check_kind(self.core, "core", "distance", "a region with a boundary, such as Sphere((0, 0, 20), 4)")
        _store(self, thickness=check_number(self.thickness, "thickness", above=0, unit="nm"))

    def contains(self, points: Floats) -> Booleans:
        """Whether points (n, 3) [nm] are in the shell, bool (n,)."""
        distance = self.core.distance(points)
        return (distance > _ON_BOUNDARY) & (distance <= self.thickness + _ON_BOUNDARY)

    def distance(self, points: Floats) -> Floats:
        """Distance from the boundary [nm], negative inside, shape (n,)."""
        distance = self.core.distance(points)
        return np.maximum(-distance, distance - self.thickness)


class Union:
    """All points that are in any of several regions.

    Parameters
    ----------
    *regions : region
        At least one region or function of points. Their union has a distance only if each of them has one.

    Raises
    ------
    ValueError
        If there is no region, or one is neither a region nor a function.
    """

    def __init__(self, *regions: Any) -> None:
        if not regions:
            raise ValueError("regions must contain at least one region, got none")
        self.regions = tuple(check_region(region, "regions") for region in regions)

    def __repr__(self) -> str:
        return f"Union({', '.join(map(repr, self.regions))})"

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Union) and self.regions == other.regions

    def __hash__(self) -> int:
        return hash(self.regions)

    def contains(self, points: Floats) -> Booleans:
        """Whether points (n, 3) [nm] are in any of the regions, bool (n,)."""
        inside = np.zeros(len(points), dtype=bool)
        for region in self.regions:
            inside |= contains(region, points)
        return inside

    def distance(self, points: Floats) -> Floats:
        """Distance from the nearest boundary [nm], negative inside, shape (n,); inside an overlap a lower bound."""
        distance = boundary_distance(self.regions[0], points)
        for region in self.regions[1:]:
            distance = np.minimum(distance, boundary_distance(region, points))
        return distance


REGIONS = {kind.__name__: kind for kind in (Sphere, Ellipsoid, Cylinder, HalfSpace, Layer, CoreShell, Union)}
"""The regions by the name under which they are described in files."""


def check_region(region: Any, name: str = "region") -> Any:
    """Return a region or a function of points; ValueError for anything else."""
    if not isinstance(region, type | Mapping) and (callable(getattr(region, "distance", None)) or callable(region)):
        return region
    raise ValueError(
        f"{name} must be a region such as Sphere((0, 0, 20), 4), or a function of points (n, 3) [nm] that returns "
        f"booleans (n,), got {short_text(region)}"
    )


def contains(region: Any, points: Floats) -> Booleans:
    """Whether points are in a region; points on its boundary are, up to rounding.

    Parameters
    ----------
    region : region or callable
        A region, or a function of points.
    points : ndarray, shape (n, 3)
        [nm].

    Returns
    -------
    ndarray of bool, shape (n,)

    Raises
    ------
    ValueError
        If a function does not return booleans of this shape.
    """
    if callable(getattr(region, "contains", None)):
        return region.contains(points)
    if callable(getattr(region, "distance", None)):
        return check_array(region.distance(points), "distance of a region", (len(points),)) <= _ON_BOUNDARY
    return check_array(region(points), "result of the function of a region", (len(points),), dtype=bool)


def boundary_distance(region: Any, points: Floats) -> Floats:
    """Distance of points (n, 3) from the boundary of a region [nm], negative inside, shape (n,).

    Raises
    ------
    ValueError
        If the region is a function, which has no distance.
    """
    if not callable(getattr(region, "distance", None)):
        raise ValueError(
            f"a profile about the boundary needs a region with a method distance, got the function {short_text(region)}"
        )
    return region.distance(points)


def region_from_dict(table: Any, name: str = "region") -> Any:
    """Make a region from its description.

    Parameters
    ----------
    table : mapping
        The name of its class under "name", and its parameters; a region in it is again such a mapping.
    name : str
        Name of the argument, for messages.

    Returns
    -------
    region

    Raises
    ------
    ValueError
        If the name or a parameter is unknown, missing or outside its range.
    """
    check_kind(table, name, Mapping, "a mapping with the name and the parameters of a region")
    kind = REGIONS[check_choice(table.get("name"), f"name of {name}", REGIONS)]
    parameters = {key: value for key, value in table.items() if key != "name"}
    if kind is Union:
        if list(parameters) != ["regions"] or not isinstance(parameters["regions"], list | tuple):
            raise ValueError(f"{name} Union must have regions, a list of regions, got {short_text(parameters)}")
        return Union(*(region_from_dict(each, f"regions of {name}") for each in parameters["regions"]))
    known = [item.name for item in fields(kind)]  # type: ignore[arg-type]
    for key in parameters:
        check_choice(key, f"parameter of {name} {kind.__name__}", known)
    if "core" in parameters:
        parameters["core"] = region_from_dict(parameters["core"], f"core of {name}")
    try:
        return kind(**parameters)
    except TypeError:
        raise ValueError(
            f"{name} {kind.__name__} must have {', '.join(known)}, got {', '.join(parameters) or 'none'}"
        ) from None
