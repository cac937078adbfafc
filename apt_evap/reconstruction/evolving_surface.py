r"""The surface of a specimen, integrated from its ions forwards in time: the response of a charged sphere.

A nearly spherical conductor :math:`r = R + h(n)`, with :math:`h/R = \sum \epsilon_l Y_l`, has to first order the
potential :math:`V [R/r + \sum \epsilon_l (R/r)^{l+1} Y_l]`. From it follow, in closed form, where an ion that starts at
rest goes, and the field of the surface (`transfer`, `EvolvingSurface`).
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np
import scipy
from numpy.typing import ArrayLike

from apt_evap._common.types import Floats, Integers
from apt_evap._common.validation import check_choice
from apt_evap._core.surface_map import place_ions
from apt_evap.reconstruction.spherical_harmonics import Coefficients, SphericalTransform

_CUTOFF = 24.0  # degree at which the volume of ions is damped to exp(-1/2), up to the following radius
_CUTOFF_RADIUS = 22.0  # nm: beyond, it grows with the root of the radius, as the number of terraces across a view,
_CUTOFF_IONS = 60_000  # if there are more ions than these in one radius of depth: their noise limits it
_LARGEST_CUTOFF = 64.0  # of a radius of 156 nm
_HIGHEST = 11 / 6  # degree of the harmonics of the surface over the cutoff
_RING = 0.82  # of the half angle of the field of view, from which the ring reaches to its rim
_RING_MEMORY = 1 / 13  # of the radius: depth over which the flux of the ring is averaged, 1 nm of R = 13 nm
_STEP = 1 / 130  # of the radius: largest depth of a step
_FORGOTTEN = 0.7  # of the time in which the fastest degree is forgotten: largest step
_GAIN = 16.0  # of the recession on the mean of V F / F_evap; constants chosen on half of the cases, see the article
_STIFFNESS = 0.03  # of the evaporation beyond the field of view: relative change of the field for a factor of e
_LARGEST_EXPONENT = 1.2
_FRAME_FROM, _FRAME_TO = math.radians(55.0), math.radians(72.0)  # ring whose mean height stays
_SPHERE_FROM, _SPHERE_WIDTH = math.radians(75.0), math.radians(5.0)  # beyond, the surface is kept spherical
DEPTH_WINDOW = 1 / 87
"""Part of the radius: depth over which shapes and voltages are averaged, 0.15 nm of R = 13 nm."""
_FIRST_AVERAGED = 8  # degree: lower ones remember more than the window, and a layer changes them as fast as it
_SWEEPS = 8  # of the search for the origin of an ion
_DAMPING = 0.65  # of the sweeps after the first: without it they diverge where the map is close to a fold


def transfer(degrees: ArrayLike) -> Floats:
    r"""Deflection of ions by a harmonic of a charged sphere.

    Parameters
    ----------
    degrees : array_like of int
        Degrees l of the harmonics.

    Returns
    -------
    ndarray
        :math:`g_l` in :math:`\delta = -g_l \epsilon_l \nabla Y_l`; 0 for l = 0.

    Notes
    -----
    A radial ion that starts at rest on a sphere of radius R has :math:`\dot r^2 \propto 1 - R/r`. Across it obeys
    :math:`d(r^2 \dot\delta)/dt = -\epsilon_l r^{-l-1} \nabla Y_l`. Integrated to infinity, with the beta function,
    :math:`g_l = B(l, 1/2) - 1/l`: 1 for l = 1 (a shift of the sphere), 0.83 for 2, 0.47 for 10, and close to
    :math:`\sqrt{\pi/l}` for large l. Ions along the normals of the surface would have 1 for all l.
    """
    orders = np.asarray(degrees, dtype=np.float64)
    least = np.maximum(orders, 1.0)
    return np.where(orders > 0, scipy.special.beta(least, 0.5) - 1 / least, 0.0)


@dataclass(frozen=True, eq=False)
class IonSequence:
    """Apparent directions of ions in sequence, and what their surface is integrated with.

    Parameters
    ----------
    directions : ndarray
        Unit vectors on the cap by the projection, shape (n, 3), with z along the axis and out of the specimen.
    volume : float
        Volume of the specimen per ion [nm^3].
    rim : float
        Angle of the rim of the field of view on the cap [rad].
    radius : float
        Radius of the cap at the first ion [nm].
    growth : float
        Increase of the radius per depth of the apex, dR/dz.
    """

    directions: Floats = field(repr=False)
    volume: float
    rim: float
    radius: float
    growth: float = 0.0

    @property
    def swept(self) -> float:
        """Volume that the cap sweeps per depth, in units of R^2."""
        cosine = math.cos(self.rim)
        return math.pi * (1 - cosine**2 - (1 - cosine) ** 2 * self.growth)

    @property
    def depths(self) -> Floats:
        """Depth of the apex of a cap that keeps its shape, before the first ion and after each [nm], shape (n + 1,)."""
        volumes: Floats = np.arange(len(self.directions) + 1, dtype=np.float64) * (self.volume / self.swept)
        if self.growth == 0:
            return volumes / self.radius**2
        grown: Floats = np.cbrt(volumes * (3 * self.growth) + self.radius**3)
        return (grown - self.radius) / self.growth

    @property
    def in_ring(self) -> np.ndarray:
        """Which ions are close to the rim of the field of view, shape (n,)."""
        return self.directions[:, 2] < math.cos(_RING * self.rim)

    @property
    def ring_part(self) -> float:
        """Part of an even flux through the field of view that is in the ring."""

        def area(cosine):
            return 1 - cosine**2 - self.growth * (1 - cosine) ** 2

        return 1 - area(math.cos(_RING * self.rim)) / area(math.cos(self.rim))

    def part(self, first: int, every: int) -> IonSequence:
        """Every n-th ion, each of n times the volume."""
        chosen = np.ascontiguousarray(self.directions[first::every])
        return IonSequence(chosen, self.volume * every, self.rim, self.radius, self.growth)


class SurfaceSteps(NamedTuple):
    """What was integrated, step by step; k steps."""

    first_ions: Integers
    """Number of the first ion of each step, and the number of ions, shape (k + 1,)."""
    nominal: Floats
    """Depth of the apex of a cap that keeps its shape, at the beginning of each step [nm], shape (k,)."""
    depths: Floats
    """Depth of the apex of the reference sphere at the beginning of each step [nm], shape (k,)."""
    recession: Floats
    """Recession of the sphere over that of a cap that keeps its shape, shape (k,)."""
    mean_field: Floats
    """Mean of V F / F_evap over the ions of each step, relative to that of the matrix, shape (k,)."""
    ring: Floats
    """Flux in the ring over its expectation, averaged over R / 13 of depth, shape (k,)."""
    fold: Floats
    """Largest reduction of area from the surface to the detector, shape (k,): the map folds at 1."""
    shapes: Coefficients
    """Coefficients of the height above the sphere [nm] at the beginning of each step, by the ions before and after it,
    shape (k, m, l)."""


class SurfacePass(NamedTuple):
    """Result of `EvolvingSurface.integrate`."""

    positions: Floats
    """x, y and z out of the specimen [nm], with the centre of the first sphere as origin, shape (n, 3)."""
    fields: Floats
    """Field of the surface at each ion, relative to the mean of the sphere, shape (n,)."""
    apex_depths: Floats
    """Depth of the apex of the sphere at each ion [nm], shape (n,)."""
    steps: SurfaceSteps


def mean_pass(first: SurfacePass, second: SurfacePass) -> SurfacePass:
    """Mean of two passes over the same ions, by two measures of the recession."""
    means: list[Any] = [(one + other) / 2 for one, other in zip(first.steps[1:], second.steps[1:], strict=True)]
    positions, fields, depths = ((one + other) / 2 for one, other in zip(first[:3], second[:3], strict=True))
    return SurfacePass(positions, fields, depths, SurfaceSteps(first.steps.first_ions, *means))


class EvolvingSurface:
    r"""Integrates the shape of a surface from the ions that leave it.

    Parameters
    ----------
    ions : IonSequence
        The ions.

    Notes
    -----
    With :math:`g_l` of `transfer`, an ion that appears at s started at n with :math:`n + \delta(n) = s`,
    :math:`\delta = -\sum g_l \epsilon_l \nabla Y_l`, and lay at (R + h) n. Its volume lowers h there. The field of the
    surface is :math:`F/F_0 = 1 + \sum (l-1) \epsilon_l Y_l`. An error of the shape is forgotten at the rate
    :math:`g_l l(l+1) - 2` per R of depth, 3, 11 and 49 for l = 2, 4 and 10: forwards in time. Backwards it would grow.

    On a shank with w = dR/dz, R = R_0 + w z, and the sphere recedes by :math:`\cos\theta - w (1-\cos\theta)` per dz.

    The shape at a time follows from the ions before it, the ions from the shapes before and after them (`settled`).
    """

    def __init__(self, ions: IonSequence) -> None:
        self.ions = ions
        # the variance of what ions add to the divergence of the map is the 7/2th power of the degree over their number
        of_noise = (ions.swept * ions.radius**3 / ions.volume / _CUTOFF_IONS) ** (2 / 7)
        cutoff = min(_CUTOFF * max(1.0, min(math.sqrt(ions.radius / _CUTOFF_RADIUS), of_noise)), _LARGEST_CUTOFF)
        self.transform = transform = SphericalTransform(round(_HIGHEST * cutoff))
        polar, azimuth = transform.polar[:, None], transform.azimuths[None, :]
        sines, cosines = np.sin(polar), np.cos(polar)
        # The pole of the grid is y, and the azimuth starts behind the specimen: the axis is in the middle of the grid.
        self.nodes = np.stack(
            [-sines * np.sin(azimuth), cosines * np.ones_like(azimuth), -sines * np.cos(azimuth)], axis=-1
        )
        self._axis = np.stack([-cosines * np.cos(azimuth), np.sin(azimuth) * np.ones_like(polar)])  # in both directions
        self._area = transform.solid_angles
        along = self.nodes[..., 2]
        angles = np.arccos(np.clip(along, -1, 1))
        self._sphere = np.maximum(along - ions.growth * (1 - along), 0.0)  # recession of the sphere per dz
        self._free = 0.5 * (1 - np.tanh((angles - _SPHERE_FROM) / _SPHERE_WIDTH))
        self._frame = (angles > _FRAME_FROM) & (angles < _FRAME_TO)
        self._near = 0.5 * (1 - np.tanh((angles - _FRAME_TO) / math.radians(4.0)))
        degrees = transform.degrees.astype(np.float64)
        self._transfer = transfer(degrees)
        self._damping = np.exp(-0.5 * (degrees / cutoff) ** 2)
        fastest = float((self._transfer * degrees * (degrees + 1) * self._damping).max())
        self.step = ions.radius * min(_FORGOTTEN / fastest, _STEP)

    def integrate(
        self,
        voltages: Floats | None = None,
        fields: Floats | None = None,
        outside: Callable[[Floats], Floats] | None = None,
        recession: str = "ring",
        rim: float = 1.0,
    ) -> SurfacePass:
        """Integrate the shape, and place the ions.

        Parameters
        ----------
        voltages : ndarray, optional
            Voltage at each ion relative to that of the matrix on a sphere, shape (n,).
        fields : ndarray, optional
            Evaporation field of each ion relative to that of the matrix, shape (n,).
        outside : callable, optional
            Evaporation field at positions beyond the field of view, shape (..., 3), relative to that of the matrix.
        recession : str
            "ring": from the flux in the ring, with the flux of a sphere beyond the field of view. "volume": that of a
            cap that keeps its shape, by the volume of the ions, which lie on this sphere in the directions that they
            come from. "surface": such that the mean of V F / F_evap stays 1, and the surface beyond evaporates by its
            own field.
        rim : float
            Flux in the ring over that of an even one while only matrix evaporates, for "ring".

        Returns
        -------
        SurfacePass
        """
        recession = check_choice(recession, "recession", ("ring", "volume", "surface"))
        ions, transform = self.ions, self.transform
        n, growth, degrees = len(ions.directions), ions.growth, transform.degrees
        voltages = np.ones(n) if voltages is None else voltages
        fields = np.ones(n) if fields is None else fields
        nominal = ions.depths
        steps = max(1, math.ceil(nominal[-1] / self.step))
        edges = np.searchsorted(nominal, np.linspace(0, nominal[-1], steps + 1))
        edges[0], edges[-1] = 0, n
        ring = self._ring_flux(edges, nominal) / rim
        apex = np.empty(n)
        kept = np.zeros((5, steps))
        shapes = np.empty((steps, degrees[-1] + 1, degrees[-1] + 1), np.complex128)
        height = np.zeros_like(shapes[0])
        depth = 0.0
        for k in range(steps):
            chosen = slice(edges[k], edges[k + 1])
            radius = ions.radius + growth * max(depth, 0.0)
            epsilon = height / radius
            # 1. what the present shape does to the ions and to the field
            scalars = np.stack([height, self._transfer * degrees * (degrees + 1) * epsilon, (degrees - 1) * epsilon])
            vectors = np.stack([-self._transfer * epsilon, epsilon])
            (heights, divergence, excess), (deflection, slope) = transform.fields_and_gradient(scalars, vectors)
            field_map = 1 + excess
            _, at_surface, counts = self.origins(ions.directions[chosen], deflection, field_map[None])
            # 2. the recession of the sphere
            volume = ions.volume * (edges[k + 1] - edges[k])
            expected = volume / (ions.swept * radius**2)
            mean = float(np.mean(voltages[chosen] * at_surface[:, 0] / fields[chosen])) if volume else 1.0
            control = float(np.clip(_GAIN * (1 - mean), -_LARGEST_EXPONENT, _LARGEST_EXPONENT))
            sunk = expected * {"ring": ring[k], "volume": 1.0, "surface": math.exp(control)}[recession]
            # 3. volume that leaves each node per solid angle: of the ions, and beyond the field of view
            gone = ions.volume * counts / self._area
            seen = (self.nodes[..., 2] + deflection[0] * self._axis[0] + deflection[1] * self._axis[1]) / np.sqrt(
                1 + (deflection**2).sum(axis=0)
            )
            beyond = seen < math.cos(ions.rim)
            even = np.maximum(seen - growth * (1 - seen), 0.0) * np.clip(1 + divergence, 0.2, 5.0) * radius**2
            if recession == "surface":
                places = (radius + heights)[..., None] * self.nodes
                places[..., 2] -= depth * (1 + growth)
                threshold = 1.0 if outside is None else outside(places)
                relative = float(np.mean(voltages[chosen])) if volume else 1.0
                exponent = (relative * field_map / threshold - 1) / _STIFFNESS
                rate = self._sphere * np.exp(np.clip(exponent, -_LARGEST_EXPONENT, _LARGEST_EXPONENT))
                weight = (beyond & self._frame) * self._area * np.maximum(self.nodes[..., 2], 0.0)
                base = sunk
                sunk = base * float((weight * rate).sum() / (weight * self._sphere).sum())
                even = self._near * rate * radius**2 * base + (1 - self._near) * even * sunk
            else:
                even = even * sunk
            gone += np.where(beyond, even, 0.0)
            within = (np.arange(edges[k + 1] - edges[k]) + 0.5) / max(1, edges[k + 1] - edges[k]) * sunk
            apex[chosen] = depth + within
            fold = float(-divergence[~beyond].min())
            kept[:, k] = nominal[edges[k]], depth, sunk / expected if expected else ring[k], mean, fold
            shapes[k] = height
            # 4. the next shape
            change = -gone / (radius + heights) ** 2 + sunk * self._sphere
            change -= sunk * (1 + growth) * (slope * self._axis).sum(axis=0)
            lowered, relaxed = transform.analysis(
                np.stack([change * self._free, 0.2 * (1 - self._free) * (heights + change * self._free)])
            )
            height = height + self._damping * lowered - relaxed
            depth += sunk
        first, below, factors, means, folds = kept
        record = SurfaceSteps(edges, first, below, factors, means, ring, folds, self.settled(shapes, below))
        return self._place(apex, record, 0.0 if recession == "volume" else 1.0)

    def settled(self, shapes: Coefficients, depths: Floats) -> Coefficients:
        """Shapes by the ions before and after each step: averaged over the depth, without the delay of the damping.

        Parameters
        ----------
        shapes : ndarray
            Coefficients that follow from the ions before each step, shape (k, m, l).
        depths : ndarray
            Depth of the apex at each step [nm], shape (k,).

        Returns
        -------
        ndarray, shape (k, m, l)

        Notes
        -----
        A degree whose volume is damped by D comes to rest at the rate D (g l (l+1) - 2) per R and is late by
        (1 - D) / D of that of an undamped one. The noise of the ions in it lasts as long as the rate says, and is less
        in a mean over the depth. Degrees 0 and 1, the frame of the sphere, stay.
        """
        steps = len(depths)
        if steps < 2 or depths[-1] <= depths[0]:
            return shapes
        degrees = self.transform.degrees.astype(np.float64)
        step = (depths[-1] - depths[0]) / (steps - 1)
        rates = np.maximum(self._transfer * degrees * (degrees + 1) - 2, 1.0)
        delays = self.ions.radius * (1 - self._damping) / (self._damping * rates) / step
        delays[:2] = 0
        parts = np.ascontiguousarray(shapes).view(np.float64).reshape(*shapes.shape, 2)
        means = scipy.ndimage.gaussian_filter1d(parts, DEPTH_WINDOW * self.ions.radius / step, axis=0, mode="nearest")
        means[:, :, :_FIRST_AVERAGED] = parts[:, :, :_FIRST_AVERAGED]
        at = np.minimum(np.arange(steps)[:, None] + delays, steps - 1)  # of each step and degree
        before = np.minimum(at.astype(np.intp), steps - 2)
        later = (at - before)[:, None, :, None]
        numbers = np.arange(len(degrees))
        first, second = (means[rows, :, numbers].transpose(0, 2, 1, 3) for rows in (before, before + 1))
        found: Coefficients = np.ascontiguousarray((1 - later) * first + later * second).view(np.complex128)[..., 0]
        return found

    def _place(self, apex, steps, tall):
        """The ions on the shapes of their steps, whose heights are taken times a factor."""
        ions, transform, growth = self.ions, self.transform, self.ions.growth
        positions, at_ions = np.empty((len(apex), 3)), np.empty(len(apex))
        for k, (depth, height) in enumerate(zip(steps.depths, steps.shapes, strict=True)):
            chosen = slice(steps.first_ions[k], steps.first_ions[k + 1])
            radius = ions.radius + growth * max(depth, 0.0)
            epsilon = height / radius
            (heights, excess), (deflection,) = transform.fields_and_gradient(
                np.stack([height, (transform.degrees - 1) * epsilon]), -(self._transfer * epsilon)[None]
            )
            directions, values, _ = self.origins(ions.directions[chosen], deflection, np.stack([heights, 1 + excess]))
            within = apex[chosen] - depth
            positions[chosen] = (radius + tall * values[:, :1] + (growth * within)[:, None]) * directions
            positions[chosen, 2] -= (depth + within) * (1 + growth)
            at_ions[chosen] = values[:, 1]
        return SurfacePass(positions, at_ions, apex, steps)

    def at_directions(self, table: Floats, directions: Floats) -> Floats:
        """Values at directions, shape (n, j), of j fields, shape (j, polar angles, azimuths)."""
        still = np.zeros((2, *table.shape[1:]))
        values: Floats = place_ions(directions, still, table, self.transform.spacing, 0, 1.0)[1]
        return values

    def origins(self, apparent: Floats, deflection: Floats, table: Floats) -> tuple[Floats, Floats, Floats]:
        """Directions of the places that ions come from, fields at them, and ions at each node.

        Parameters
        ----------
        apparent : ndarray
            Unit vectors s where they appear, shape (n, 3).
        deflection : ndarray
            Deflection delta at the nodes along the polar angle and the azimuth [rad], shape (2, ...).
        table : ndarray
            Fields at the nodes, shape (j, ...).

        Returns
        -------
        directions : ndarray, shape (n, 3)
            Unit vectors n with n + delta(n) along s.
        values : ndarray, shape (n, j)
            Bilinear between the nodes.
        counts : ndarray
            Ions at each node, each shared among four.
        """
        placed: tuple[Floats, Floats, Floats] = place_ions(
            apparent, np.ascontiguousarray(deflection), table, self.transform.spacing, _SWEEPS, _DAMPING
        )
        return placed

    def _ring_flux(self, edges, nominal):
        """Flux in the ring over its expectation for each step, shape (k,)."""
        ions = self.ions
        counts = np.concatenate([[0], np.cumsum(ions.in_ring)])[edges]
        ring, every = np.diff(counts).astype(np.float64), np.diff(edges).astype(np.float64)
        memory = _RING_MEMORY * ions.radius / (nominal[-1] / len(every))
        smooth = [scipy.ndimage.gaussian_filter1d(part, memory, mode="nearest") for part in (ring, every)]
        return smooth[0] / np.maximum(smooth[1], 1e-9) / ions.ring_part
