"""Checks of a reconstruction that its user can read: planes, density, field of view."""

import math
from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np

from apt_evap._common.validation import check_array, check_kind, check_number, check_pairs
from apt_evap.reconstruction.calibration import distribution_map
from apt_evap.reconstruction.reconstructed import Reconstruction

_LEAST_AMPLITUDE = 0.05  # of planes that are resolved
_GOOD = 0.05  # relative: a deviation that needs no attention


class Check(NamedTuple):
    """A property of a reconstruction beside its expectation."""

    name: str
    """What it is, with its unit."""
    found: float
    """In the reconstruction; NaN if it cannot be determined."""
    expected: float
    """From what is known; for a limit, the limit."""
    meaning: str
    """What a deviation says."""

    is_limit: bool = False
    """Whether the expectation is an upper limit."""

    @property
    def good(self) -> bool:
        """Whether both agree within 5 %, or the limit is kept."""
        excess = self.found / self.expected - 1
        return bool(excess <= 0 if self.is_limit else abs(excess) <= _GOOD)

    def __repr__(self) -> str:
        known = f"{self.found:.4g}, {'at most' if self.is_limit else 'expected'} {self.expected:.4g}"
        ratio = "not determined" if math.isnan(self.found) else known
        return f"<Check: {self.name}: {ratio}{'' if self.good else f'; {self.meaning}'}>"


def checks(
    reconstruction: Reconstruction, planes: Mapping[str, tuple[Any, float]] | None = None, radius: float = 2.0
) -> list[Check]:
    """Check a reconstruction by observables that it did not use.

    Parameters
    ----------
    reconstruction : Reconstruction
        The reconstruction.
    planes : mapping, optional
        Poles by name: the position of the pole on the detector, x and y [mm], and the spacing of its planes [nm]. Two
        poles at different angles test radius and compression together.
    radius : float
        Radius of the cylinder along each pole whose ions are used [nm].

    Returns
    -------
    list of Check
        For each pole the spacing of its planes; the number of ions per volume within half the field of view; and with
        a lens the angle on the cap at the rim of the field of view, against that at which the electrode stops ions.

    Raises
    ------
    ValueError
        If a position or a spacing is invalid.

    Examples
    --------
    >>> rng = np.random.default_rng(1)
    >>> radius, azimuth = 20 * np.sqrt(rng.random(50_000)), 2 * np.pi * rng.random(50_000)  # mm, uniform
    >>> ions = ae.Hits(x=radius * np.cos(azimuth), y=radius * np.sin(azimuth))
    >>> lens = ae.detection.LocalElectrode.preset("local electrode")
    >>> reconstruction = ae.reconstruct(ions, atomic_volume=0.011, distance=90.0, radius=30.0, lens=lens)
    >>> for check in ae.reconstruction.checks(reconstruction):
    ...     print(check)
    <Check: ions per nm^3 near the axis: 86.62, expected 90.91>
    <Check: angle on the cap at the rim [degrees]: 17.58, at most 37.48>
    """
    check_kind(reconstruction, "reconstruction", Reconstruction, "a Reconstruction")
    width = check_number(radius, "radius", above=0, unit="nm")
    known = check_pairs({} if planes is None else planes, "planes", "a mapping from names to places and spacings")
    spacings = [
        _planes(reconstruction, name, check_array(place, f"position of {name}", (2,)), spacing, width)
        for name, (place, spacing) in known
    ]
    limits = [_rim(reconstruction)] if reconstruction.settings.lens is not None else []
    return [*spacings, density_near_axis(reconstruction), *limits]


def _rim(reconstruction):
    """Angle on the cap of the outermost ions, against the largest one that passes the electrode."""
    radius = float(np.median(reconstruction.radii))
    widest = reconstruction.settings.lens.widest_angle(radius)
    meaning = "ions from there would touch the electrode: the flight length, the shank or the aperture is wrong"
    rim = float(np.quantile(reconstruction.angles, 0.999))
    return Check("angle on the cap at the rim [degrees]", rim, widest, meaning, is_limit=True)


def _planes(reconstruction, name, place, spacing, width):
    """Spacing of the planes at a pole, from the ions that hit the detector there."""
    spacing = check_number(spacing, f"spacing of {name}", above=0, unit="nm")
    hits = reconstruction.hits
    distance = np.hypot(hits.x - place[0], hits.y - place[1])
    nearest = np.argsort(distance)[: max(50, len(hits) // 1000)]
    centre, radii = reconstruction.positions[nearest].mean(axis=0), reconstruction.radii[nearest].mean()
    # the pole is normal to the cap: from the centre of the cap, whose depth is below the apex by the radius
    lateral = centre[:2] / radii
    normal = np.array([*lateral, -math.sqrt(max(1 - float(lateral @ lateral), 0.0))])
    near = np.linalg.norm(np.cross(reconstruction.positions - centre, normal), axis=1) < width
    value = math.nan
    if near.sum() >= 20:
        try:
            distances = distribution_map(reconstruction.positions[near], normal, reach=4 * spacing, lateral=width / 2)
            value = distances.spacing if distances.amplitude >= _LEAST_AMPLITUDE else math.nan
        except ValueError:  # no pair of ions is close enough
            pass
    meaning = "planes too far apart: the efficiency is too small, or the radius too large; too close: the reverse"
    return Check(f"spacing of the {name} planes [nm]", value, spacing, meaning)


def density_near_axis(reconstruction: Reconstruction) -> Check:
    """Ions per volume within half the field of view, against the efficiency over the atomic volume."""
    settings = reconstruction.settings
    assert settings.atomic_volume is not None
    expected = settings.efficiency / settings.atomic_volume
    near, rim = reconstruction.core
    # from cap to cap: the depth of the apex, so that the curvature does not matter
    first, last = reconstruction.depths_of([0, -1])
    volume = math.pi * rim**2 * float(last - first)
    value = np.count_nonzero(near) / volume if volume > 0 else math.nan
    small = "more than expected: the compression is too small, or ions are focused on the axis"
    large = "fewer than expected: the compression is too large, or ions are deflected from the axis"
    meaning = small if value > expected else large
    return Check("ions per nm^3 near the axis", float(value), expected, meaning)
