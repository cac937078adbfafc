"""The shell of atoms that is held below the surface of a large tip."""

from dataclasses import dataclass

import numpy as np

from apt_evap._common.types import Booleans, Floats
from apt_evap.specimen.shape import TaperedCap

_SKIN = 3.2  # neighbour radii held below the surface where hardly an atom leaves: two of them are support


@dataclass(frozen=True)
class Shell:
    """Which part of a shape is held: all of it, or the atoms down to a depth.

    In the cap atoms are held down to `depth` below its surface; from z = 0 downwards, where fewer and fewer atoms
    leave, the depth falls to a skin. The innermost layer, one neighbourhood thick, is support: its atoms complete the
    neighbourhoods of others and never evaporate.

    Parameters
    ----------
    shape : TaperedCap
        Shape of the tip.
    depth : float or None
        Depth below the surface of the cap [nm]; None holds every atom.
    neighbour_radius : float
        Radius of the neighbourhood that tells surface atoms [nm].
    """

    shape: TaperedCap
    depth: float | None
    neighbour_radius: float

    @property
    def _ramp(self):
        """Depth of the skin, and the height over which `depth` falls to it, at a slope of at most 1 [nm]."""
        skin = min(_SKIN * self.neighbour_radius, self.depth)
        return skin, max(self.shape.apex_radius / 2, self.depth - skin)

    def depth_at(self, points: Floats) -> Floats:
        """Depth down to which atoms are held at the height of some points (n, 3) [nm], shape (n,)."""
        skin, ramp = self._ramp
        return skin + (self.depth - skin) * np.clip(1 + points[:, 2] / ramp, 0, 1)

    def volume(self) -> float:
        """Volume that is held [nm^3], a close upper estimate."""
        if self.depth is None:
            return self.shape.volume()
        radius, (skin, ramp) = self.shape.apex_radius, self._ramp
        cap = 2 / 3 * np.pi * (max(0.0, radius - skin) ** 3 - max(0.0, radius - self.depth) ** 3)
        flank = np.pi * radius * ramp * (self.depth - skin)
        return min(self.shape.volume(), self.shape.volume(skin) + cap + flank)

    def support(self, positions: Floats) -> Booleans:
        """Atoms at some positions (n, 3) [nm] that only complete the neighbourhoods of others, bool (n,)."""
        if self.depth is None:
            return np.zeros(len(positions), dtype=bool)
        skin, ramp = self._ramp
        lost = self.neighbour_radius * (1 + (self.depth - skin) / ramp)  # across one neighbourhood
        return self.shape.signed_distance(positions) < lost - self.depth_at(positions)

    def evaporable(self, positions: Floats, support: Booleans) -> Booleans:
        """Atoms at some positions (n, 3) [nm] that may leave, bool (n,): above half the shank, and no support."""
        return (positions[:, 2] >= -self.shape.shank_length / 2) & ~support

    def below(self, positions: Floats, rounding: float) -> Booleans:
        """Positions (n, 3) [nm] that are deeper than this shell by more than `rounding` [nm], bool (n,)."""
        return self.shape.signed_distance(positions) < -(self.depth_at(positions) + rounding)
