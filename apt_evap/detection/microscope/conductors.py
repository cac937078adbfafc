"""Panels of the specimen and of the electrode; the apex is at z = 0, the electrode at z > 0."""

import math
from typing import NamedTuple

import numpy as np
import scipy

from apt_evap._common.types import Floats
from apt_evap.detection.microscope.boundary_elements import Panels

CAP_PANELS = 40
_SHANK_GROWTH = 0.06
_ELECTRODE_GROWTH = 0.12
_RIM = 0.02  # length of the first panel of the electrode in radii of the aperture: the charge is singular at its rim
# radius of the electrode in its distance or aperture: behind it are only the fields that pass the aperture (measured:
# potentials below 1e-6 of the voltage; with 20, 7e-4 pass outside. k_f differs by 1e-4)
_ELECTRODE_SIZE = 1000
_LEAST_SLOPE = 1e-3  # rad, above a profile that starts as a cylinder
_FOOT_POINTS = 40  # of the rounded foot of a simulated specimen


class Flank(NamedTuple):
    """Line where a cap ends on the surface of a specimen."""

    angle: float
    """Half angle of the shank there [rad]."""
    path: Floats
    """Line of the shank below it, rho and z from the apex of this cap [nm], shape (n, 2)."""
    recession: float
    """Distance of the apex from the initial one [nm]."""


def straight_flank(radius: float, angle: float, length: float) -> Flank:
    """Flank of a cone, with a cap of this radius [nm], half the opening angle [rad], and a length [nm]."""
    start = radius * np.array([math.cos(angle), math.sin(angle) - 1])
    return Flank(angle, np.array([start, start + length * np.array([math.sin(angle), -math.cos(angle)])]), 0.0)


def measured_flank(radius: float, profile: Floats, angle: float, length: float) -> Flank:
    """Flank of a cap that touches a measured profile, and of a cone of this half opening angle [rad] below the profile.

    `profile` has the distance from the initial apex and the radius of the shank [nm], shape (n, 2), both increasing.
    `length` is that of the shank [nm].
    """
    depths, radii = profile.T
    curve = scipy.interpolate.PchipInterpolator(depths, radii)
    fine = np.unique(np.concatenate([depths, np.linspace(depths[0], depths[-1], 400)]))
    slopes = np.arctan(curve(fine, 1))
    # radii and centres of the spheres that touch the profile; below and above it they touch cones
    touching = np.maximum.accumulate(curve(fine) / np.cos(slopes))
    if touching[0] < radius < touching[-1]:
        at = float(np.interp(radius, touching, fine))
        slope = float(np.arctan(curve(at, 1)))
        rest = np.column_stack([curve(fine), fine])[fine > at]
    else:  # on a cone that continues the profile upwards or downwards
        above = radius <= touching[0]
        slope = max(float(slopes[0]), _LEAST_SLOPE) if above else angle
        end = 0 if above else -1
        at = float(depths[end] + (radius * math.cos(slope) - radii[end]) / math.tan(slope))
        rest = np.column_stack([curve(fine), fine])[fine > at] if above else np.empty((0, 2))
    apex = at + radius * math.sin(slope) - radius
    start = np.array([radius * math.cos(slope), at])
    path = np.vstack([start, rest[rest[:, 1] > at + 1e-6 * radius]])
    end = path[-1] + length * np.array([math.sin(angle), math.cos(angle)])
    path = np.vstack([path, end])
    return Flank(slope, path * (1, -1) + (0, apex), apex)


def specimen(radius: float, flank: Flank, refinement: int = 1) -> Panels:
    """Panels of a spherical cap on a shank, at the potential 1.

    Parameters
    ----------
    radius : float
        Radius of the cap [nm].
    flank : Flank
        The shank below it.
    refinement : int
        Factor of the number of panels.
    """
    count = CAP_PANELS * refinement
    angles = np.linspace(0, math.pi / 2 - flank.angle, count + 1)
    cap = radius * np.column_stack([np.sin(angles), np.cos(angles) - 1])
    first = radius * (angles[1] - angles[0])
    shank = graded(flank.path, first, _SHANK_GROWTH / refinement)
    points = np.vstack([cap, shank[1:]])
    centres = np.concatenate([np.full(count, -radius), np.full(len(shank) - 1, np.nan)])
    return Panels(points[:-1], points[1:], centres, np.ones(len(centres)))


def electrode(distance: float, aperture: float, angle: float, refinement: int = 1) -> Panels:
    """Panels of a cone with an aperture, at the potential 0.

    z and radius of the aperture are in nm, the half opening angle of the cone in rad: pi/2 for a plane. `refinement` is
    a factor of the number of panels.
    """
    length = _ELECTRODE_SIZE * max(distance, aperture) / math.sin(angle)
    rim = np.array([aperture, distance])
    path = np.array([rim, rim + length * np.array([math.sin(angle), math.cos(angle)])])
    points = graded(path, _RIM * aperture / refinement, _ELECTRODE_GROWTH / refinement)
    return Panels(points[:-1], points[1:], np.full(len(points) - 1, np.nan), np.zeros(len(points) - 1))


def graded(path: Floats, first: float, growth: float) -> Floats:
    """Points along a line [nm], shape (n, 2), at distances that grow from `first` [nm] by the factor 1 + growth."""
    along = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(path, axis=0).T))])
    count = max(1, math.ceil(math.log1p(along[-1] * growth / first) / math.log1p(growth)))
    steps = np.concatenate([[0.0], np.cumsum((1 + growth) ** np.arange(count))])
    steps *= along[-1] / steps[-1]
    return np.column_stack([np.interp(steps, along, path[:, 0]), np.interp(steps, along, path[:, 1])])


def simulated_flank(radius: float, angle: float, centre: float, foot: float, rounded: bool) -> Flank:
    """Flank of a simulated specimen, which ends after a short shank of this half opening angle [rad].

    `foot` is the radius of a sphere that touches the shank, its centre is at the distance `centre` from that of the cap
    [nm]. The specimen ends there in a flat base unless it is `rounded`.
    """
    sin, cos = math.sin(angle), math.cos(angle)
    start = [radius * cos, radius * (sin - 1)]
    depth = -radius - centre
    if rounded:
        around = np.linspace(angle, -math.pi / 2, _FOOT_POINTS)
        end = foot * np.column_stack([np.cos(around), np.sin(around)]) + (0, depth)
        end[-1, 0] = 0.0
    else:
        end = np.array([[foot / cos, depth], [0.0, depth]])
    return Flank(angle, np.vstack([start, end]), 0.0)
