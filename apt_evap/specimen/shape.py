"""The shape of a tip: a spherical cap on a cone, as a signed distance."""

import math
from dataclasses import replace

import numpy as np

from apt_evap._common.codec import choice, number, settings
from apt_evap._common.types import Floats
from apt_evap._core.elementary import sine_and_cosine

_LONGEST = 1e7  # [nm]: 1 cm is larger than any tip, and volumes keep their precision


@settings
class TaperedCap:
    """A spherical cap on a shank that widens downwards.

    The convex hull of two spheres, tangent everywhere: the cap of radius R around the origin, its apex at z = R, and
    the foot of radius R + L sin(alpha) around z = -L. Between them is the cone rho cos(alpha) + z sin(alpha) = R. With
    ``base="flat"`` this cone continues to z = -L and is cut there.

    Raises
    ------
    ValueError
        If a number is outside its range, or the base is unknown.
    """

    apex_radius: float = number("Radius R of the cap", above=0, at_most=_LONGEST, unit="nm")
    shank_length: float = number("Length L of the shank", above=0, at_most=_LONGEST, unit="nm")
    shank_angle: float = number(
        "Half the opening angle alpha of the shank", default=1.5, at_least=0, below=45, unit="degrees"
    )
    base: str = choice("Form of its lower end", ("rounded", "flat"), default="rounded")

    @property
    def _flank(self):
        sin, cos = (float(value) for value in sine_and_cosine(math.radians(self.shank_angle)))
        return sin, cos, self.apex_radius + self.shank_length * sin

    @property
    def bounds(self) -> Floats:
        """Lower and upper corner of the box around the shape [nm], shape (2, 3)."""
        _, cos, foot = self._flank
        rounded = self.base == "rounded"
        width = foot if rounded else foot / cos
        bottom = -self.shank_length - foot * rounded
        return np.array([[-width, -width, bottom], [width, width, self.apex_radius]])

    def signed_distance(self, points: Floats) -> Floats:
        """Distance from the surface [nm], negative inside.

        Exact for the rounded base. For the flat base it is the larger of the distances from the cone and from the plane
        of the base, which outside near the rim is smaller than the true distance.

        Parameters
        ----------
        points : ndarray
            [nm], shape (n, 3).

        Returns
        -------
        ndarray
            Shape (n,).
        """
        sin, cos, foot_radius = self._flank
        x, y, z = points[:, 0], points[:, 1], points[:, 2]
        rho = np.sqrt(x * x + y * y)
        along = rho * sin - z * cos  # down the flank, from where it meets the cap
        distance = rho * cos + z * sin - self.apex_radius
        cap = along < 0
        distance[cap] = np.sqrt(rho[cap] ** 2 + z[cap] ** 2) - self.apex_radius
        if self.base == "flat":
            return np.maximum(distance, -self.shank_length - z)
        foot = along > self.shank_length * cos
        distance[foot] = np.sqrt(rho[foot] ** 2 + (z[foot] + self.shank_length) ** 2) - foot_radius
        return distance

    def volume(self, depth: float | None = None) -> float:
        """Volume of the shape, or of the shell from its surface down to `depth` [nm^3]."""
        if depth is not None:
            inner = self.apex_radius - depth, self.shank_length - depth * (self.base == "flat")
            hollow = min(inner) > 0
            core = replace(self, apex_radius=inner[0], shank_length=inner[1]).volume() if hollow else 0.0
            return self.volume() - core
        if self.base == "flat":
            return self.volume_above(-self.shank_length)
        sin, _, foot = self._flank
        below = 4 / 3 * math.pi * foot**3 - _cap_volume(foot, foot * sin)
        return self.volume_above(foot * sin - self.shank_length) + below

    def volume_above(self, z: float) -> float:
        """Volume of the part of the shape above a height `z` on its flank [nm^3]."""
        sin, cos, _ = self._flank
        top, upper, lower = self.apex_radius * sin, self.apex_radius * cos, (self.apex_radius - z * sin) / cos
        frustum = math.pi / 3 * (top - z) * (upper**2 + upper * lower + lower**2)
        return _cap_volume(self.apex_radius, top) + frustum


def _cap_volume(radius, height):
    """Volume of the part of a sphere above `height`."""
    return math.pi / 3 * (radius - height) ** 2 * (2 * radius + height)
