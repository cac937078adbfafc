"""Where a direction of the specimen appears on the detector, and back."""

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from apt_evap._common.types import Floats
from apt_evap._common.validation import check_array, check_number, check_switch


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
        x, y, z = check_array(directions, "directions", ("n", 3)).T
        across = np.hypot(x, y)
        angle = np.arctan2(across, z)
        last = math.pi / 2 if self.compression is None else min(1.0, self.compression) * math.pi / 2
        ahead = angle < last
        radius = self._radius(np.where(ahead, angle, 0.0))
        share = np.divide(radius, across, out=np.zeros_like(radius), where=across > 0)
        share[~ahead] = np.nan
        return np.column_stack([-x if self.mirror else x, y]) * share[:, None] + self.centre

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
        angle = radius / self.scale
        if self.compression is not None:
            angle = self.compression * np.arctan(angle / self.compression)
        share = np.divide(np.sin(angle), radius, out=np.full_like(radius, 1 / self.scale), where=radius > 0)
        return np.column_stack([(-x if self.mirror else x) * share, y * share, np.cos(angle)])

    def _radius(self, angle):
        if self.compression is None:
            return self.scale * angle
        return self.scale * self.compression * np.tan(angle / self.compression)
