"""The cap of an emitter: its radius, and its mean field, to which literature evaporation fields refer."""

import math
from typing import NamedTuple

import numpy as np

from apt_evap._common.sphere import fit_sphere
from apt_evap._common.types import Floats
from apt_evap._core.elementary import sine_and_cosine, total
from apt_evap._core.sphere_sums import in_cone

HALF_ANGLE = 45.0  # degrees from the axis: about what an instrument sees, and far from the shank
FEWEST = 12  # surface atoms: three times the unknowns of the sphere
# Of the apex radius, for a tip before its first event: the rounds shrink towards a facet otherwise. Chosen with Be,
# Mg and Ti [0001] and [10-10] of 6 to 10 a: 0.34 to 0.59 where the atoms deviate from the sphere by more than 0.07 R
# (rms), 0.71 to 0.91 elsewhere. Judged with Ni, W, Ru and Si of 3 to 10 a: 0.48 with 0.088 R, 0.61 to 0.98 with 0.077
# R and less.
LEAST_RADIUS = 0.6
_ROUNDS = 3  # the selection of atoms depends on the centre; it changed by less than 1e-3 R after the second round


class Cap(NamedTuple):
    """The cap of a surface: the surface atoms within 45 degrees of the axis, seen from the centre of their sphere.

    Parameters
    ----------
    field : float
        Mean field just outside these atoms [V/nm], weighted with their charges.
    ratio : float
        Mean ratio of this field to the evaporation field of the atom, with the same weights.
    radius : float
        Radius of the sphere fitted to these atoms [nm].
    apex : float
        z of the top of this sphere [nm].
    """

    field: float
    ratio: float
    radius: float
    apex: float


NO_CAP = Cap(math.nan, math.nan, math.nan, math.nan)
"""Result of `measure_cap` for a surface with too few atoms around the axis."""


def measure_cap(positions: Floats, normals: Floats, fields: Floats, evaporation_fields: Floats) -> Cap:
    """Fit a sphere to the surface atoms around the axis +z [nm], and average fields [V/nm]; NaN for less than 12 atoms.

    The mean with the charges as weights is V/R for a sphere: the field F is twice that of the other charges, and the
    sum of q r.E over all charges is their energy Q V/2 (virial theorem). Measured on spheres of fcc atoms: 2.2, 1.0 and
    0.5 % less at R = 12, 24 and 40 a. A mean without weights is 13 % less: it counts atoms below steps fully. The fit
    of the sphere (`fit_sphere`) begins with atoms whose normals are within 45 degrees of the axis.
    """
    cosine = float(sine_and_cosine(math.radians(HALF_ANGLE))[1])
    chosen = np.flatnonzero(normals[:, 2] >= cosine)
    radius = math.nan
    for _ in range(_ROUNDS):
        if len(chosen) < FEWEST:
            return NO_CAP
        centre, radius = fit_sphere(positions, chosen)
        chosen = in_cone(positions, *centre, cosine)
    if len(chosen) < FEWEST:
        return NO_CAP
    fields = fields[chosen]
    weights = fields / total(fields)  # fields are proportional to charges
    ratio = total(weights * fields / evaporation_fields[chosen])
    return Cap(total(weights * fields), ratio, radius, float(centre[2]) + radius)


def doubt_of_cap(radius: float, apex_radius: float | None) -> str:
    """What is wrong with the cap of a tip before its first event, from the radii of both [nm], "" if nothing is."""
    if math.isnan(radius):
        return (
            f'field_reference = "cap" needs at least {FEWEST} evaporable atoms within {HALF_ANGLE:g} degrees of the '
            'axis, the tip has fewer: use a larger apex_radius, or field_reference = "site"'
        )
    if apex_radius is not None and radius < LEAST_RADIUS * apex_radius:
        return (
            f'field_reference = "cap" needs a cap of at least {LEAST_RADIUS:g} of the apex_radius {apex_radius:.3g} '
            f'nm, got {radius:.3g} nm, on a facet: use a larger apex_radius, or field_reference = "site"'
        )
    return ""
