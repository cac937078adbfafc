"""Constants of a reconstruction that nobody has stated: values to start from, and what they change."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np

from apt_evap._common.validation import check_choice
from apt_evap.reconstruction.reconstructed import Reconstruction, cap_reconstruction

STARTS: Mapping[str, tuple[str, str]] = {
    "distance": ("90", "mm, of straight flights behind a local electrode; 382 with a reflectron: its data sheet"),
    "element": ("NAME", "the main element; or --atomic-volume [nm^3] of a compound: its density"),
    "evaporation_field": ("VALUE", "that of the main element [V/nm], from tables such as `apt_evap.materials()`"),
    "field_factor": ("3.3", "of the literature, 2 to 5; from the width of lattice planes at a pole"),
    "compression": ("1.5", "of the literature, 1.3 to 1.8; from the angles between poles"),
    "efficiency": ("0.57", "of straight flights, 0.37 to 0.52 with a reflectron, 0.8 of the newest: its data sheet"),
    "initial_radius": ("30", "nm, from an electron micrograph"),
    "shank_angle": ("5", "degrees, half the angle of a cone, from an electron micrograph"),
}
"""Value to start from of each constant, and where it comes from."""

_CHANGE = 0.1  # relative
_IONS = 20_000  # that are reconstructed: width and depth are means over many ions


class Assumption(NamedTuple):
    """A constant that was assumed, and relative changes of the result if it is 10 % smaller, and 10 % larger."""

    name: str
    """Field of `ReconstructionSettings`."""
    value: float
    """Value that was assumed."""
    width: tuple[float, float]
    """Change of the width."""
    depth: tuple[float, float]
    """Change of the depth."""
    density: tuple[float, float]
    """Change of the number of ions per volume."""

    def __str__(self) -> str:
        def pair(changes):
            return " and ".join("none" if math.isnan(change) else f"{change:+.0%}" for change in changes)

        start, source = STARTS[self.name]
        usual = source if float(start) == self.value else f"usual is {start} {source}"
        return (
            f"assumed {self.name.replace('_', ' ')} {self.value:g} ({usual}): 10 % less and more change the width by "
            f"{pair(self.width)}, the depth by {pair(self.depth)}, the density by {pair(self.density)}"
        )


def assumptions(reconstruction: Reconstruction, names: Sequence[str]) -> list[Assumption]:
    """What 10 % of constants change in width, depth and density of a reconstruction.

    Parameters
    ----------
    reconstruction : Reconstruction
        The reconstruction.
    names : sequence of str
        Fields of `ReconstructionSettings`: "compression", "field_factor", "efficiency", "evaporation_field", ...

    Returns
    -------
    list of Assumption
        One for each name whose constant the reconstruction has; none for ions without a width or a depth, such as a
        single one. NaN where ions would leave the cap.

    Notes
    -----
    The cap of the same ions is reconstructed with either value. The density is the number of ions per width squared and
    depth.

    Examples
    --------
    >>> rng = np.random.default_rng(1)
    >>> radius, azimuth = 20 * np.sqrt(rng.random(5000)), 2 * np.pi * rng.random(5000)  # mm
    >>> ions = ae.Hits(x=radius * np.cos(azimuth), y=radius * np.sin(azimuth))
    >>> result = ae.reconstruct(ions, atomic_volume=0.0166, distance=90.0, radius=30.0)
    >>> print(ae.reconstruction.assumptions(result, ["efficiency"])[0])
    assumed efficiency 1 (usual is 0.57 of straight flights, 0.37 to 0.52 with a reflectron, 0.8 of the newest: its data
    sheet): 10 % less and more change the width by +0% and +0%, the depth by +11% and -9%, the density by -10% and +10%
    """
    settings, known = reconstruction.settings, reconstruction.geometry
    stride = -(-len(reconstruction) // _IONS)
    hits = reconstruction.hits[::stride]
    radii = reconstruction.radii[::stride] if settings.mode == "given" else settings.radius

    def extents(**changes: Any) -> tuple[float, float]:
        changed = replace(settings, **({"radius": radii} | changes))
        found = cap_reconstruction(hits, replace(changed, efficiency=changed.efficiency / stride))[0]
        return float(np.sqrt(found.positions[:, :2].var(axis=0).sum())), float(found.depths[-1])

    usual = extents()
    if not all(usual):  # one ion, or all at one place
        return []
    found = []
    for name in names:
        check_choice(name, "names", tuple(STARTS))
        value = getattr(settings, name)
        if not isinstance(value, int | float):
            continue
        changes = []
        for factor in (1 - _CHANGE, 1 + _CHANGE):
            changed = value * factor
            try:
                if name == "efficiency":  # may exceed 1 here: the volume per ion is what counts
                    width, depth = extents(atomic_volume=known.volume * settings.efficiency * value / changed)
                else:
                    width, depth = extents(**{name: changed})
            except ValueError:  # ions would leave the cap
                changes.append((math.nan,) * 3)
                continue
            wider, deeper = width / usual[0], depth / usual[1]
            changes.append((wider - 1, deeper - 1, 1 / (wider**2 * deeper) - 1))
        found.append(Assumption(name, float(value), *zip(*changes, strict=True)))
    return found
