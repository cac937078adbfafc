"""What the emission and the lattice do to a surface that follows the ions, measured in a simulated twin."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np
import scipy

from apt_evap._common.types import Floats
from apt_evap.reconstruction.evolving_surface import EvolvingSurface, IonSequence
from apt_evap.reconstruction.reconstructed import cap_reconstruction
from apt_evap.reconstruction.reconstruction_settings import resolved_settings
from apt_evap.simulation.run import Run
from apt_evap.specimen.lattice import atom_density

NEIGHBOURS = 100
"""Ions of a mean error. 16, 50, 100 and 200 of the 12,000 of a twin of R = 6 nm leave lateral errors of 0.241, 0.235,
0.232 and 0.232 nm of 0.312 nm (sphere of 1.2 times the field, R = 12 nm)."""

_FEWEST = 2000  # ions of the twin in the field of view
_MOST = 60_000  # of more, every n-th
_PART = 65_536  # places at a time
_BLOCKS = 50  # of the sequence
_FIRST_SHAPE = 0.2  # of the radius, in depth: until the twin has forgotten that it began as a sphere
_LARGEST = 0.2  # of the radius: scatter of a twin whose map of origins does not fold
_FITS = 3  # of radius and compression, each within the field of view by the one before
_WIDTH = math.radians(3.0)  # of the Gaussian of a density on the detector
_BINS = 61
_HALVES = 16  # of the field of view, in which a twin has to be that of the matrix: one grain of two is a part of it
_DOUBT = 0.5  # of the mean errors: a twin of another radius, of an orientation that is wrong by degrees
_FLOOR = 0.05  # of a density: a cell without ions of the twin does not decide alone


@dataclass(frozen=True, eq=False)
class TwinErrors:
    """Errors of the reconstruction of a simulated specimen whose true sites are known.

    Terraces are as wide as the square root of the radius times their height. The errors are taken to grow like them.

    Parameters
    ----------
    directions : ndarray
        Unit vectors on the cap by the projection of its hits, shape (n, 3).
    errors : ndarray
        True minus reconstructed positions [nm], z out of the specimen, shape (n, 3), without those of the recession.
    radius : float
        Radius of its cap [nm].
    rim : float
        Angle of the rim of the field of view on the cap [rad].
    """

    directions: Floats = field(repr=False)
    errors: Floats = field(repr=False)
    radius: float
    rim: float

    @classmethod
    def of(cls, run: Run, rim: float, recession: str = "ring") -> TwinErrors:
        """Reconstruct a run in the same field of view as a measurement, with the constants that fit its sites best."""
        volume, distance = _atomic_volume(run), run.detector.distance
        hits = run.hits(run.first_perturbation)
        radius, compression = float(run.settings["tip"]["apex_radius"]), 1.0
        for _ in range(_FITS):
            settings = resolved_settings(
                None,
                {
                    "atomic_volume": volume, "distance": distance, "projection": "compressed",
                    "detector_radius": distance * math.tan(rim / compression), "compression": compression,
                    "radius": radius,
                },
            )  # fmt: skip
            cap, rows = cap_reconstruction(hits, settings)
            if len(cap) < _FEWEST:
                raise ValueError(f"twin must have at least {_FEWEST:,} ions in the field of view, got {len(cap):,}")
            fitted = cap.errors(run.emissions.positions[rows], fit=("shift", "radius", "compression"))
            radius, compression = radius * fitted.radius_factor, fitted.compression
        places, angles = cap.geometry.places(cap.hits, cap.radii)
        if angles.max() < 0.98 * rim:
            raise ValueError(
                f"twin must cover the field of view of {math.degrees(rim):.0f} degrees on the cap, got ions to "
                f"{math.degrees(angles.max()):.0f} degrees"
            )
        ions = IonSequence(np.column_stack([places, np.cos(angles)]), cap.geometry.volume, rim, radius)
        every = -(-len(cap) // _MOST)
        ions, sites = ions.part(0, every), run.emissions.positions[rows[::every]]
        errors = sites - EvolvingSurface(ions).integrate(recession=recession).positions
        kept = ions.depths[1:] > _FIRST_SHAPE * radius
        if np.count_nonzero(kept) < _FEWEST / 2:
            raise ValueError(f"twin must be deeper than 0.2 of its radius, got {ions.depths[-1] / radius:.2f}")
        found = cls(ions.directions[kept], without_means(errors[kept], _BLOCKS), radius, rim)
        along, _ = found.scatter(radius)
        if along > _LARGEST * radius:
            raise ValueError(
                f"twin must be larger or its field of view narrower: its errors of {along:.1f} nm are more than "
                f"{_LARGEST:g} of its radius"
            )
        return found

    def __post_init__(self):
        object.__setattr__(self, "_tree", scipy.spatial.cKDTree(self.directions))

    def gains(self, directions: Floats) -> tuple[float, float]:
        """Mean logarithm of the density of the twin on the cap at ions, relative to that of an even flux.

        It is above 0 if the measured density is closer to that of the twin than to an even one: in the whole field of
        view, and in the half of it where this is smallest, with both densities normalised there.
        """
        rim = math.sin(self.rim)  # an even flux is even in x / R and y / R
        edges = np.linspace(-1.02 * rim, 1.02 * rim, _BINS + 1)
        x, y = np.meshgrid(*[(edges[1:] + edges[:-1]) / 2] * 2, indexing="ij")
        inside = x**2 + y**2 < rim**2
        width = _WIDTH / (edges[1] - edges[0])
        own, measured = (_counts(part, edges) for part in (self.directions, directions))
        seen = np.maximum(scipy.ndimage.gaussian_filter(inside.astype(float), width), _FLOOR)
        density = np.maximum(scipy.ndimage.gaussian_filter(own, width) / seen, _FLOOR * own.sum() / inside.sum())

        def gain(cells):
            logarithms = np.log(density[cells] / density[cells].mean())
            return float((measured[cells] * logarithms).sum() / max(measured[cells].sum(), 1))

        turns = np.arange(_HALVES) * (2 * math.pi / _HALVES)
        return gain(inside), min(gain(inside & (x * math.cos(turn) + y * math.sin(turn) > 0)) for turn in turns)

    def shifts_at(self, directions: Floats, radii: Floats) -> Floats:
        """Mean error of the nearest ions of the twin, at directions on caps of some radii [nm], shape (n, 3)."""
        means = np.empty((len(directions), 3))
        for first in range(0, len(directions), _PART):
            part = slice(first, first + _PART)
            means[part] = self.errors[self._tree.query(directions[part], k=NEIGHBOURS)[1]].mean(axis=1)  # type: ignore[attr-defined]
        return means * np.sqrt(radii / self.radius)[:, None]

    def scatter(self, radius: float) -> tuple[float, float]:
        """What the mean errors leave along the surface, in each of two directions, and across it [nm]."""
        means = self.shifts_at(self.directions, np.full(len(self.directions), self.radius))
        # the mean has an error, too; half of the mean is in doubt
        parts = (1 + 1 / NEIGHBOURS, self.errors - means), (_DOUBT**2, means)
        across = along = 0.0
        for factor, part in parts:
            normal = (np.einsum("ni,ni->n", part, self.directions) ** 2).mean()
            across += factor * float(normal)
            along += factor * float((part**2).sum(axis=1).mean() - normal) / 2
        scale = math.sqrt(radius / self.radius)
        return math.sqrt(along) * scale, math.sqrt(across) * scale


def without_means(errors: Floats, blocks: int) -> Floats:
    """Errors less the mean of each block of the sequence, which is one of the recession, shape (n, 3)."""
    return np.concatenate([part - part.mean(axis=0) for part in np.array_split(errors, blocks) if len(part)])


def _counts(directions, edges):
    """Ions in each cell of x / R and y / R, shape (bins, bins)."""
    return np.histogram2d(directions[:, 0], directions[:, 1], bins=(edges, edges))[0]


def _atomic_volume(run):
    """Volume of an atom of the matrix of a run [nm^3]."""
    tip = run.settings["tip"]
    phases = tip.get("phases", [])
    if ("material" not in tip and not phases) or len(phases) > 1:
        got = f"{len(phases)} phases" if phases else "a specimen from positions"
        raise ValueError(f"twin must be a run of a pure crystal, got {got}")
    crystal = tip["material"] if "material" in tip else phases[0]["material"]
    return 1 / atom_density(crystal["structure"], crystal["a"], crystal["c"])
