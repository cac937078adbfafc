"""The shell: atoms near the surface of a large tip."""

from dataclasses import dataclass

import numpy as np

from apt_evap._common.types import Booleans, Floats
from apt_evap.specimen.shape import TaperedCap

_SKIN = 3.2  # thickness where few atoms evaporate [neighbour radii]; two of them are support


@dataclass(frozen=True)
class Shell:
    """Part of a shape that contains atoms: all of it, or a shell below the surface.

    In the cap the shell reaches to `depth` below the surface. Below z = 0, where fewer atoms evaporate, its thickness
    decreases to that of a skin. The innermost layer, one neighbourhood thick, is support: its atoms complete the
    neighbourhoods of others and never evaporate.

    Parameters
    ----------
    shape : TaperedCap
        Shape of the tip.
    depth : float or None
        Thickness below the surface of the cap [nm]; None for all atoms.
    neighbour_radius : float
        Radius of the neighbourhood that identifies surface atoms [nm].
    """

    shape: TaperedCap
    depth: float | None
    neighbour_radius: float

    @property
    def _ramp(self):
        """Thickness of the skin, and the height over which `depth` decreases to it, at a slope <= 1 [nm]."""
        skin = min(_SKIN * self.neighbour_radius, self.depth)
        return skin, max(self.shape.apex_radius / 2, self.depth - skin)

    def depth_at(self, points: Floats) -> Floats:
        """Thickness of the shell at the height of points (n, 3) [nm], shape (n,)."""
        skin, ramp = self._ramp
        return skin + (self.depth - skin) * np.clip(1 + points[:, 2] / ramp, 0, 1)

    def volume(self) -> float:
        """Upper estimate of the volume that contains atoms [nm^3]."""
        if self.depth is None:
            return self.shape.volume()
        radius, (skin, ramp) = self.shape.apex_radius, self._ramp
        cap = 2 / 3 * np.pi * (max(0.0, radius - skin) ** 3 - max(0.0, radius - self.depth) ** 3)
        flank = np.pi * radius * ramp * (self.depth - skin)
        return min(self.shape.volume(), self.shape.volume(skin) + cap + flank)

    def support(self, positions: Floats) -> Booleans:
        """Whether atoms at positions (n, 3) [nm] only complete the neighbourhoods of others, bool (n,)."""
        if self.depth is None:
            return np.zeros(len(positions), dtype=bool)
        skin, ramp = self._ramp
        drop = self.neighbour_radius * (1 + (self.depth - skin) / ramp)  # decrease across one neighbourhood
        return self.shape.signed_distance(positions) < drop - self.depth_at(positions)

    def evaporable(self, positions: Floats, support: Booleans) -> Booleans:
        """Whether atoms at positions (n, 3) [nm] can evaporate, bool (n,): above half the shank, and not support."""
        return (positions[:, 2] >= -self.shape.shank_length / 2) & ~support

    def below(self, positions: Floats, rounding: float) -> Booleans:
        """Whether positions (n, 3) [nm] are deeper than this shell by more than `rounding` [nm], bool (n,)."""
        return self.shape.signed_distance(positions) < -(self.depth_at(positions) + rounding)
