"""Projections of directions onto the detector: plane, azimuthal equidistant and compressed, forth and back.

A projection is the distance r from the centre of the detector for the polar angle theta, over its scale D:

=====================  ==================  =======================================================
plane                  tan(theta)          straight flights onto a plane detector, ``compression`` 1
compressed             xi tan(theta / xi)  the same with the image compression xi
azimuthal equidistant  theta               ``compression`` None, the limit of a large xi
=====================  ==================  =======================================================

Flights end in stereographic directions, s = tan(theta / 2) (cos, sin)(azimuth), which stay smooth and finite up to ions
that fly along a plane detector and beyond, where their place on it does not.
"""

import math
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike

from apt_evap._common.small_matrices import lengths
from apt_evap._common.types import Floats
from apt_evap._common.validation import check_array, check_number, check_switch
from apt_evap._core.elementary import arctangent


def polar_angles(directions: Floats) -> Floats:
    """Angles from the z axis [rad], shape (n,), of directions of any length, shape (n, 3)."""
    return np.arctan2(np.hypot(directions[:, 0], directions[:, 1]), directions[:, 2])


def stereographic(directions: Floats) -> Floats:
    """Stereographic directions, shape (n, 2), of directions of any length, shape (n, 3)."""
    return directions[:, :2] / (lengths(directions) + directions[:, 2])[:, None]


def stereographic_stretch(s2: Floats, compression: float | None) -> Floats:
    """Distance from the centre over the scale and the length of the stereographic direction, r / (D |s|).

    Parameters
    ----------
    s2 : ndarray
        Squared lengths of stereographic directions, tan(theta / 2)^2 < 1, shape (n,).
    compression : float or None
        As for `Projection`.

    Returns
    -------
    ndarray
        Shape (n,); 2 on the axis, as tan(theta / 2) is half as large as theta.
    """
    if compression == 1.0:
        return 2.0 / (1.0 - s2)  # tan(theta) / tan(theta / 2)
    s = np.sqrt(s2)
    return np.where(s > 0, radius_of(2.0 * arctangent(s), compression) / s, 2.0)


def along_axis(lengths: Floats, s2: Floats) -> Floats:
    """Lengths times the cosine of the polar angle, (1 - s^2) / (1 + s^2), of stereographic directions of length s."""
    return lengths * (1.0 - s2) / (1.0 + s2)


def radius_of(angle: Floats, compression: float | None) -> Floats:
    """Distances from the centre over the scale for polar angles [rad], of the same shape."""
    return angle if compression is None else compression * np.tan(angle / compression)


def angle_of(radius: Floats, compression: float | None) -> Floats:
    """Polar angles [rad] for distances from the centre over the scale, of the same shape."""
    return radius if compression is None else compression * np.arctan(radius / compression)


@dataclass(frozen=True)
class Projection:
    """A projection of the directions of the specimen onto the detector.

    Parameters
    ----------
    scale : float
        Distance on the detector for an angle on the specimen, at the centre [mm/rad].
    centre : tuple of float
        Where the axis of the specimen meets the detector [mm].
    mirror : bool
        Whether x of the map counts against x of the specimen.
    compression : float, optional
        None is the azimuthal equidistant projection. A number is the image compression of a straight flight onto a
        plane detector, where the detector is seen under the angle of the specimen divided by it.

    Raises
    ------
    ValueError
        If the scale or the compression is not above 0, or the centre is not a place.

    Notes
    -----
    With the polar angle theta from the axis and the image compression xi, the distance from the centre is
    r = scale theta, or r = scale xi tan(theta / xi). Measured maps are closer to the first (De Geuser and Gault,
    Microsc. Microanal. 23, 238 (2017)); simulated ions on a plane are described by the second (`image_compression`).
    """

    scale: float
    centre: tuple = (0.0, 0.0)
    mirror: bool = False
    compression: float | None = None

    def __post_init__(self):
        object.__setattr__(self, "scale", check_number(self.scale, "scale", above=0, unit="mm/rad"))
        object.__setattr__(self, "centre", tuple(check_array(self.centre, "centre", (2,)).tolist()))
        object.__setattr__(self, "mirror", check_switch(self.mirror, "mirror"))
        if self.compression is not None:
            compression = check_number(self.compression, "compression", above=0)
            object.__setattr__(self, "compression", compression)

    def places(self, directions: ArrayLike) -> Floats:
        """Where directions appear.

        Parameters
        ----------
        directions : array_like
            In the frame of the specimen, of any length, shape (n, 3).

        Returns
        -------
        ndarray
            x and y [mm], shape (n, 2); NaN for a direction that points away from the detector.
        """
        directions = check_array(directions, "directions", ("n", 3))
        x, y, _ = directions.T
        across, angle = np.hypot(x, y), polar_angles(directions)
        ahead = angle < self.last_angle
        radius = self.scale * radius_of(np.where(ahead, angle, 0.0), self.compression)
        stretch = np.divide(radius, across, out=np.zeros_like(radius), where=across > 0)
        stretch[~ahead] = np.nan
        return np.column_stack([-x if self.mirror else x, y]) * stretch[:, None] + self.centre

    def directions(self, places: ArrayLike) -> Floats:
        """Directions that appear at some places.

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
        angle = angle_of(radius / self.scale, self.compression)
        stretch = np.divide(np.sin(angle), radius, out=np.full_like(radius, 1 / self.scale), where=radius > 0)
        return np.column_stack([(-x if self.mirror else x) * stretch, y * stretch, np.cos(angle)])

    def angles(self, places: ArrayLike) -> Floats:
        """Polar angles [rad], shape (n,), of the directions that appear at places x and y [mm], shape (n, 2)."""
        x, y = (check_array(places, "places", ("n", 2), finite=False) - self.centre).T
        return angle_of(np.hypot(x, y) / self.scale, self.compression)

    @property
    def last_angle(self) -> float:
        """Polar angle from which on a direction points away from the detector [rad]."""
        return math.pi / 2 if self.compression is None else min(1.0, self.compression) * math.pi / 2

    @property
    def rim(self) -> float:
        """Distance from the centre at which the last directions appear [mm]; infinite up to a compression of 1."""
        if self.compression is not None and self.compression <= 1:
            return math.inf
        return self.scale * float(radius_of(np.array(self.last_angle), self.compression))

    def compressed(self, compression: float) -> "Projection":
        """The projection of a specimen whose polar angles are `compression` times those seen by this one."""
        compression = check_number(compression, "compression", above=0)
        own = None if self.compression is None else self.compression * compression
        return replace(self, scale=self.scale / compression, compression=own)
