"""Similarity transforms of the detector plane: mirror, rotation, scale and shift."""

from dataclasses import dataclass, replace
from typing import Any

import numpy as np


@dataclass(frozen=True)
class SimilarityTransform:
    """Similarity transform of points z = x + iy [mm] of a simulated map into the frame of a measured one.

    Parameters
    ----------
    rotation : float
        Rotation, anticlockwise [degrees].
    scale : float
        Measured mm per simulated mm.
    mirror : bool
        Whether y changes sign, before the rotation.
    anchor : complex
        A simulated point [mm].
    place : complex
        The measured point to which the anchor is moved [mm].

    Notes
    -----
    With the anchor a and its place b, a point z moves to z' = b + scale exp(i rotation) (z - a), with the complex
    conjugate of z - a if mirrored. Rotation and scale do not move the place of the anchor.
    """

    rotation: float
    scale: float
    mirror: bool = False
    anchor: complex = 0j
    place: complex = 0j

    @property
    def factor(self) -> complex:
        """Rotation and scale as one complex factor."""
        return self.scale * np.exp(1j * np.radians(self.rotation))

    def apply(self, points: Any) -> Any:
        """Move simulated points into the measured frame, complex of any shape."""
        offset = points - self.anchor
        return self.place + self.factor * (np.conj(offset) if self.mirror else offset)

    def apply_inverse(self, points: Any) -> Any:
        """Move measured points into the simulated frame, complex of any shape."""
        offset = (points - self.place) / self.factor
        return self.anchor + (np.conj(offset) if self.mirror else offset)

    def anchored(self, place: complex) -> "SimilarityTransform":
        """Return the same transform, with the point that is moved to `place` as its anchor."""
        return replace(self, anchor=self.apply_inverse(place), place=place)

    @property
    def inverse(self) -> "SimilarityTransform":
        """The transform from the measured into the simulated frame."""
        rotation = self.rotation if self.mirror else -self.rotation
        return SimilarityTransform(rotation, 1 / self.scale, self.mirror, self.place, self.anchor)
