"""Regions of a specimen: where a phase is.

Coordinates are those of the specimen [nm]: the centre of the cap is the origin, z is the axis, and the apex is at
z = apex_radius. A point at the depth t below the apex is (0, 0, apex_radius - t).
"""

from collections.abc import Mapping
from typing import Any, Protocol

import numpy as np

from apt_evap._common.codec import checked, from_plain, is_plain, number, settings, vector
from apt_evap._common.small_matrices import lengths, products
from apt_evap._common.types import Booleans, Floats
from apt_evap._common.validation import check_array, check_kind, check_number, check_sequence, short_text

_ON_BOUNDARY = 1e-7  # [nm]: sites on the boundary belong to the region, in spite of rounding
_BISECTIONS = 60  # the position is then exact to the rounding of float64


class Region(Protocol):
    """Interface of a region with a boundary: a class of a user's own needs this method only."""

    def distance(self, points: Floats) -> Floats:
        """Distance from the boundary [nm], negative inside; points (n, 3) [nm] -> (n,)."""
        ...


def _direction(vector, name):
    if not 1e-6 < float(lengths(np.array(vector))) < 1e6:
        raise ValueError(f"{name} must be a direction with a length between 1e-6 and 1e6, got {short_text(vector)}")
    return vector


def _unit(direction):
    """Unit vector along a checked direction, which is itself stored as given."""
    vector = np.array(direction)
    return vector / lengths(vector)


@settings
class Sphere:
    """A ball, such as a precipitate or a bubble."""

    centre: tuple[float, float, float] = vector("Its centre.", 3, unit="nm")
    radius: float = number("Its radius.", above=0, unit="nm")

    def distance(self, points: Floats) -> Floats:
        """Distance from the boundary [nm], negative inside, shape (n,)."""
        return lengths(points - np.array(self.centre)) - self.radius


@settings
class Ellipsoid:
    """An ellipsoid, such as a platelet or a needle."""

    centre: tuple[float, float, float] = vector("Its centre.", 3, unit="nm")
    semi_axes: tuple[float, float, float] = vector("Half the length of the three axes.", 3, above=0, unit="nm")
    axis: tuple[float, float, float] = vector(
        "Direction of the third axis in the specimen. For another one than +z, the first axis is turned with it, along "
        "the great circle; this matters only if the first two are unequal.",
        3,
        check=_direction,
        default=(0.0, 0.0, 1.0),
    )

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


@settings
class Cylinder:
    """A cylinder, such as a rod or a wire."""

    centre: tuple[float, float, float] = vector("Its centre.", 3, unit="nm")
    radius: float = number("Its radius.", above=0, unit="nm")
    length: float | None = number("Its length; by default it has no ends.", default=None, above=0, unit="nm")
    axis: tuple[float, float, float] = vector(
        "Its direction in the specimen.", 3, check=_direction, default=(0.0, 0.0, 1.0)
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


@settings
class Box:
    """A box along the axes of the coordinates."""

    lower: tuple[float, float, float] = vector("Its corner with the smallest coordinates.", 3, unit="nm")
    upper: tuple[float, float, float] = vector("Its corner with the largest coordinates.", 3, unit="nm")

    def _check(self):
        for low, high in zip(self.lower, self.upper, strict=True):
            check_number(high, "upper", above=low, unit="nm")

    def distance(self, points: Floats) -> Floats:
        """Distance from the boundary [nm], negative inside, shape (n,)."""
        low, high = np.array(self.lower), np.array(self.upper)
        beyond = np.maximum(low - points, points - high)
        return np.where((beyond > 0).any(axis=1), lengths(np.maximum(beyond, 0.0)), beyond.max(axis=1))


@settings
class HalfSpace:
    """Everything on one side of a plane, such as the second grain of a bicrystal."""

    point: tuple[float, float, float] = vector("Any point of the plane.", 3, unit="nm")
    normal: tuple[float, float, float] = vector("Normal of the plane, towards the region.", 3, check=_direction)

    def distance(self, points: Floats) -> Floats:
        """Distance from the boundary [nm], negative inside, shape (n,)."""
        return -products(points - np.array(self.point), _unit(self.normal))


@settings
class Layer:
    """The space between two parallel planes, such as a layer of a multilayer."""

    lower: float = number(
        "Position of the lower plane along the normal. For the default normal it is the height z: the apex is at z = "
        "apex_radius.",
        unit="nm",
    )
    upper: float = number("Position of the upper plane.", unit="nm")
    normal: tuple[float, float, float] = vector("Normal of the planes.", 3, check=_direction, default=(0.0, 0.0, 1.0))

    def _check(self):
        check_number(self.upper, "upper", above=self.lower, unit="nm")

    def distance(self, points: Floats) -> Floats:
        """Distance from the boundary [nm], negative inside, shape (n,)."""
        along = products(points, _unit(self.normal))
        return np.maximum(self.lower - along, along - self.upper)


@settings
class CoreShell:
    """The shell around a core: all points outside the core, but at most a thickness away from it."""

    core: Any = checked(
        "The core, which does not belong to this region; usually the region of another phase.",
        "region",
        lambda core, name: with_boundary(core, name),
        read=lambda plain, name: region_of(plain, name),
    )
    thickness: float = number("Thickness of the shell.", above=0, unit="nm")

    def contains(self, points: Floats) -> Booleans:
        """Whether points (n, 3) [nm] are in the shell, bool (n,)."""
        distance = self.core.distance(points)
        return (distance > _ON_BOUNDARY) & (distance <= self.thickness + _ON_BOUNDARY)

    def distance(self, points: Floats) -> Floats:
        """Distance from the boundary [nm], negative inside, shape (n,)."""
        distance = self.core.distance(points)
        return np.maximum(-distance, distance - self.thickness)


def _check_regions(regions, name):
    regions = check_sequence(regions, name, "regions")
    if len(regions) == 0:
        raise ValueError(f"{name} must contain at least one region, got none")
    return tuple(check_region(region, name) for region in regions)


@settings
class Union:
    """All points that are in any of several regions: ``Union((first, second))``.

    Their union has a distance only if each of them has one.
    """

    regions: tuple = checked(
        "At least one region or function of points.",
        "regions",
        _check_regions,
        read=lambda plain, name: [region_of(region, name) for region in check_sequence(plain, name, "regions")],
    )

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


REGIONS = (Sphere, Ellipsoid, Cylinder, Box, HalfSpace, Layer, CoreShell, Union)
"""The built-in regions, which a file can contain."""


def check_region(region: Any, name: str = "region") -> Any:
    """Return a region or a function of points; ValueError for anything else."""
    if not isinstance(region, type | Mapping) and (callable(getattr(region, "distance", None)) or callable(region)):
        return region
    raise ValueError(
        f"{name} must be a region such as Sphere((0, 0, 20), 4), or a function of points (n, 3) [nm] that returns "
        f"booleans (n,), got {short_text(region)}"
    )


def with_boundary(region: Any, name: str) -> Any:
    """Return a region with a boundary; ValueError for a function of points, which has none, or anything else."""
    return check_kind(check_region(region, name), name, "distance", "a region such as Sphere((0, 0, 20), 4)")


def contains(region: Any, points: Floats) -> Booleans:
    """Whether points (n, 3) [nm] are in a region or a function says so; points on the boundary are, up to rounding."""
    if callable(getattr(region, "contains", None)):
        return region.contains(points)
    if callable(getattr(region, "distance", None)):
        return check_array(region.distance(points), "distance of a region", (len(points),)) <= _ON_BOUNDARY
    return check_array(region(points), "result of the function of a region", (len(points),), dtype=bool)


def boundary_distance(region: Any, points: Floats) -> Floats:
    """Distance of points (n, 3) from the boundary of a region [nm], negative inside, shape (n,)."""
    if not callable(getattr(region, "distance", None)):
        raise ValueError(
            f"a profile about the boundary needs a region with a method distance, got the function {short_text(region)}"
        )
    return region.distance(points)


def region_of(plain: Any, name: str = "region") -> Any:
    """Region from its plain form; ValueError if it was a function or a class of the user, which no run contains."""
    return from_plain(plain, *REGIONS, what=name) if is_plain(plain) else plain
