"""Projections of directions onto the detector and back: plane, azimuthal equidistant and compressed.

A projection gives the distance r from the centre of the detector, divided by its scale D, for the polar angle theta:

=====================  ==================  =======================================================
plane                  tan(theta)          straight flights onto a plane detector, ``compression`` 1
compressed             xi tan(theta / xi)  the same with the image compression xi
azimuthal equidistant  theta               ``compression`` None, the limit of a large xi
with a lens            theta (1 - b        ``barrel`` b: positive if the lens compresses the rim,
                       theta^2)            negative if it stretches the rim (pincushion)
=====================  ==================  =======================================================

The directions at the end of flights are stereographic, s = tan(theta / 2) (cos, sin)(azimuth). They stay smooth and
finite also for ions that fly parallel to a plane detector or away from it, where the position on it diverges.
"""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
from numpy.typing import ArrayLike

from apt_evap._common.codec import number, settings, switch, vector
from apt_evap._common.small_matrices import lengths
from apt_evap._common.types import Floats
from apt_evap._common.validation import check_array, check_number
from apt_evap._core.elementary import arctangent


def polar_angles(directions: Floats) -> Floats:
    """Angles from the z axis [rad], shape (n,), of directions of any length, shape (n, 3)."""
    return np.arctan2(np.hypot(directions[:, 0], directions[:, 1]), directions[:, 2])


def stereographic(directions: Floats) -> Floats:
    """Stereographic directions, shape (n, 2), of directions of any length, shape (n, 3)."""
    return directions[:, :2] / (lengths(directions) + directions[:, 2])[:, None]


def stereographic_stretch(s2: Floats, compression: float | None) -> Floats:
    """Ratio r / (D |s|) of distance from the centre over scale D and length of the stereographic direction.

    `s2` are squared lengths, tan(theta / 2)^2 < 1, shape (n,); the ratio is 2 on the axis, where tan(theta / 2) = theta
    / 2.
    """
    if compression == 1.0:
        return 2.0 / (1.0 - s2)  # tan(theta) / tan(theta / 2)
    s = np.sqrt(s2)
    return np.where(s > 0, radius_of(2.0 * arctangent(s), compression) / s, 2.0)


def along_axis(lengths: Floats, s2: Floats) -> Floats:
    """Lengths times the cosine of the polar angle, (1 - s^2) / (1 + s^2), of stereographic directions of length s."""
    return lengths * (1.0 - s2) / (1.0 + s2)


def radius_of(angle: Floats, compression: float | None, barrel: float = 0.0) -> Floats:
    """Distances from the centre divided by the scale for polar angles [rad], of the same shape."""
    if barrel:
        return angle * (1.0 - barrel * angle * angle)
    return angle if compression is None else compression * np.tan(angle / compression)


def angle_of(radius: Floats, compression: float | None, barrel: float = 0.0) -> Floats:
    """Polar angles [rad] for distances from the centre divided by the scale, of the same shape.

    With a barrel term b they are the root of angle (1 - b angle^2) = radius next to 0 (Cardano's formulas); for
    distances that no angle reaches, the angle of the largest distance.
    """
    if barrel:
        root = math.sqrt(3 * abs(barrel))
        triple = 1.5 * root * radius
        if barrel > 0:
            return (2 / root) * np.sin(np.arcsin(np.minimum(triple, 1.0)) / 3)
        return (2 / root) * np.sinh(np.arcsinh(triple) / 3)
    return radius if compression is None else compression * np.arctan(radius / compression)


@settings
class Projection:
    """Projection of directions in the specimen onto the detector.

    Raises
    ------
    ValueError
        If the scale or the compression is not positive, the centre is not a position, or a compression and a barrel
        term are both given.

    Notes
    -----
    With the polar angle theta from the axis and the image compression xi, the distance from the centre is
    r = scale theta, or r = scale xi tan(theta / xi); with a barrel term, r = scale theta (1 - b theta^2), the first two
    terms of any lens that is symmetric about its axis. Measured maps are closer to the first (De Geuser and Gault,
    Microsc. Microanal. 23, 238 (2017)); simulated ions on a plane are described by the second (`image_compression`).
    """

    scale: float = number("Distance on the detector per angle in the specimen, at the centre", above=0, unit="mm/rad")
    centre: tuple = vector("Position of the specimen axis on the detector", 2, default=(0.0, 0.0), unit="mm")
    mirror: bool = switch("Whether x of the map is opposite to x of the specimen", default=False)
    compression: float | None = number(
        "None for the azimuthal equidistant projection. A number is the image compression xi onto a plane detector: "
        "the angle in the specimen divided by the angle of the straight flight.",
        default=None,
        above=0,
    )
    barrel: float = number(
        "Term b of a lens, without a compression: the rim at the angle theta is nearer to the centre by the fraction "
        "b theta^2.",
        default=0.0,
        unit="1/rad^2",
    )

    def _check(self):
        if self.barrel and self.compression is not None:
            raise ValueError(f"give compression or barrel, not both, got {self.compression:g} and {self.barrel:g}")

    def places(self, directions: ArrayLike) -> Floats:
        """Positions of directions on the detector.

        Parameters
        ----------
        directions : array_like
            Vectors of any length in the frame of the specimen, shape (n, 3).

        Returns
        -------
        ndarray
            x and y [mm], shape (n, 2); NaN for a direction that points away from the detector.
        """
        directions = check_array(directions, "directions", ("n", 3))
        x, y, _ = directions.T
        across, angle = np.hypot(x, y), polar_angles(directions)
        ahead = angle < self.last_angle
        radius = self.scale * radius_of(np.where(ahead, angle, 0.0), self.compression, self.barrel)
        stretch = np.divide(radius, across, out=np.zeros_like(radius), where=across > 0)
        stretch[~ahead] = np.nan
        return np.column_stack([-x if self.mirror else x, y]) * stretch[:, None] + self.centre

    def directions(self, places: ArrayLike) -> Floats:
        """Directions at positions on the detector.

        Parameters
        ----------
        places : array_like
            x and y [mm], shape (n, 2).

        Returns
        -------
        ndarray
            Unit vectors in the frame of the specimen, shape (n, 3).
        """
        x, y = (check_array(places, "places", ("n", 2)) - self.centre).T
        radius = np.hypot(x, y)
        angle = angle_of(radius / self.scale, self.compression, self.barrel)
        stretch = np.divide(np.sin(angle), radius, out=np.full_like(radius, 1 / self.scale), where=radius > 0)
        return np.column_stack([(-x if self.mirror else x) * stretch, y * stretch, np.cos(angle)])

    def angles(self, places: ArrayLike) -> Floats:
        """Polar angles [rad], shape (n,), of the directions at positions x and y [mm], shape (n, 2)."""
        x, y = (check_array(places, "places", ("n", 2), finite=False) - self.centre).T
        return angle_of(np.hypot(x, y) / self.scale, self.compression, self.barrel)

    @property
    def last_angle(self) -> float:
        """Polar angle above which a direction points away from the detector, or a barrel folds the image [rad]."""
        if self.barrel > 0:
            return min(math.pi / 2, 1 / math.sqrt(3 * self.barrel))
        return math.pi / 2 if self.compression is None else min(1.0, self.compression) * math.pi / 2

    @property
    def rim(self) -> float:
        """Distance from the centre for the last angle [mm]; infinite for a compression <= 1."""
        if self.compression is not None and self.compression <= 1:
            return math.inf
        return self.scale * float(radius_of(np.array(self.last_angle), self.compression, self.barrel))

    def compressed(self, compression: float) -> Projection:
        """Projection for polar angles in the specimen that are `compression` times the angles of this projection."""
        compression = check_number(compression, "compression", above=0)
        product = None if self.compression is None else self.compression * compression
        barrel = self.barrel / compression**2
        return replace(self, scale=self.scale / compression, compression=product, barrel=barrel)
