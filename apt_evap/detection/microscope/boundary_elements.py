"""Charges and fields of conductors with an axis of symmetry, by boundary elements.

The surface consists of rings with a constant surface density of charge. In the half plane (rho, z), a ring is a
straight panel, or an arc about a point on the axis. Units: a charge q at the distance r has the potential q / r.
"""

from typing import NamedTuple

import numpy as np
import scipy

from apt_evap._common.types import Floats

_FINE = np.polynomial.legendre.leggauss(12)
_COARSE = np.polynomial.legendre.leggauss(3)
_NEAR = 2.5  # panel lengths; beyond, 3 nodes have relative errors below 1e-5 (theory of the Gauss rule: 8^-6)
_ON_AXIS = 1e-4  # of the distance: below, the closed form of the radial field cancels to fewer than 12 digits


class Panels(NamedTuple):
    """Panels of conductors in the half plane (rho, z)."""

    starts: Floats
    """First ends [nm], shape (n, 2)."""
    ends: Floats
    """Other ends [nm], shape (n, 2)."""
    centres: Floats
    """z of the centres of arcs [nm], shape (n,); NaN for straight panels."""
    potentials: Floats
    """Potentials of the conductors, shape (n,)."""

    @property
    def arcs(self) -> Floats:
        """Angles of the ends of arcs from the z axis [rad], shape (n, 2); NaN for straight panels."""
        return np.column_stack([np.arctan2(end[:, 0], end[:, 1] - self.centres) for end in (self.starts, self.ends)])

    @property
    def lengths(self) -> Floats:
        """Lengths [nm], shape (n,)."""
        straight = np.hypot(*(self.ends - self.starts).T)
        radius, angles = np.hypot(self.ends[:, 0], self.ends[:, 1] - self.centres), self.arcs
        return np.where(np.isnan(self.centres), straight, radius * np.abs(angles[:, 1] - angles[:, 0]))

    def places(self, nodes: Floats) -> Floats:
        """Places on the panels [nm], shape (n, m, 2), at nodes from -1 to 1, shape (m,)."""
        places = (self.starts + self.ends)[:, None] / 2 + (self.ends - self.starts)[:, None] / 2 * nodes[:, None]
        arc = ~np.isnan(self.centres)
        angles, centres = self.arcs[arc], self.centres[arc]
        radius = np.hypot(self.ends[arc, 0], self.ends[arc, 1] - centres)[:, None]
        angle = angles.mean(axis=1)[:, None] + (angles[:, 1] - angles[:, 0])[:, None] / 2 * nodes
        places[arc] = np.stack([radius * np.sin(angle), centres[:, None] + radius * np.cos(angle)], axis=-1)
        return places

    def areas(self, places: Floats, weights: Floats) -> Floats:
        """Areas [nm^2] that belong to places of a quadrature with weights, shape (n, m)."""
        return 2 * np.pi * places[..., 0] * weights * self.lengths[:, None] / 2


def joined(*parts: Panels) -> Panels:
    """All panels of several conductors."""
    return Panels(*(np.concatenate(columns) for columns in zip(*parts, strict=True)))


def ring_potential(rho: Floats, z: Floats, radius: Floats, height: Floats) -> Floats:
    """Potential [1/nm] at points (rho, z) of rings with the charge 1, radius and height in nm; all are broadcast.

    It is 2/pi K(m) / s with s^2 = (rho + radius)^2 + (z - height)^2.
    """
    far = (rho + radius) ** 2 + (z - height) ** 2
    near = (rho - radius) ** 2 + (z - height) ** 2
    # 1 - m from the distances: m itself loses all digits at the ring
    return 2 / np.pi * scipy.special.ellipkm1(near / far) / np.sqrt(far)


def ring_field(rho: Floats, z: Floats, radius: Floats, height: Floats) -> tuple[Floats, Floats, Floats]:
    """Potential [1/nm], and radial and axial field [1/nm^2], of rings with the charge 1.

    Arguments are those of `ring_potential`.
    """
    above = z - height
    far = (rho + radius) ** 2 + above**2
    near = (rho - radius) ** 2 + above**2
    complement, distance = near / far, np.sqrt(far)
    first, second = scipy.special.ellipkm1(complement), scipy.special.ellipe(1 - complement)
    axial = 2 / np.pi * above * second / (near * distance)
    across = np.maximum(rho, _ON_AXIS * distance)
    radial = (first - (radius**2 - rho**2 + above**2) / near * second) / (np.pi * across * distance)
    on_axis = (
        rho / 2 * (2 * above**2 - radius**2) / (radius**2 + above**2) ** 2.5
    )  # from the second derivative along the axis
    return 2 / np.pi * first / distance, np.where(rho < _ON_AXIS * distance, on_axis, radial), axial


class ChargedPanels:
    """Conductors with the charges that give them their potentials.

    Parameters
    ----------
    panels : Panels
        Without two panels at the same place.

    Notes
    -----
    The potential in the middle of every panel is that of its conductor (collocation). Sums over a panel use 12 Gauss
    points, for the panel itself with nodes that become denser towards its middle, as t^3.
    """

    def __init__(self, panels: Panels) -> None:
        self.panels = panels
        self.lengths = panels.lengths
        self.middles = panels.places(np.zeros(1))[:, 0]
        nodes, weights = _FINE
        places = panels.places(nodes)
        areas = panels.areas(places, weights)
        rho, z = (column[:, None, None] for column in self.middles.T)
        matrix = (ring_potential(rho, z, places[..., 0], places[..., 1]) * areas).sum(axis=-1)
        half = (nodes + 1) / 2
        graded, graded_weights = half**3, weights / 2 * 3 * half**2
        nodes, weights = np.concatenate([-graded, graded]), np.tile(graded_weights, 2)
        places_on_panels = panels.places(nodes)
        itself = ring_potential(
            self.middles[:, :1], self.middles[:, 1:], places_on_panels[..., 0], places_on_panels[..., 1]
        )
        np.fill_diagonal(matrix, (itself * panels.areas(places_on_panels, weights)).sum(axis=-1))
        densities = np.linalg.solve(matrix, panels.potentials)
        self.surface_fields: Floats = 4 * np.pi * densities
        """Field just outside each panel per unit of potential [1/nm], shape (n,)."""
        self.charges: Floats = densities * areas.sum(axis=-1)
        """Charge of each panel per unit of potential [nm], shape (n,)."""
        coarse = panels.places(_COARSE[0])
        self._fine = places, areas * densities[:, None]
        self._coarse = coarse, panels.areas(coarse, _COARSE[1]) * densities[:, None]

    def fields(self, rho: Floats, z: Floats) -> tuple[Floats, Floats, Floats]:
        """Potentials, radial and axial fields [1/nm] at points of the half plane [nm], each of shape (n,).

        At distances from a panel below half its length, the nodes of the quadrature are visible.
        """
        distance = np.hypot(rho[:, None] - self.middles[:, 0], z[:, None] - self.middles[:, 1]).min(axis=0)
        near = distance < _NEAR * self.lengths
        places = np.concatenate([self._fine[0][near].reshape(-1, 2), self._coarse[0][~near].reshape(-1, 2)])
        charges = np.concatenate([self._fine[1][near].ravel(), self._coarse[1][~near].ravel()])
        potential, radial, axial = ring_field(rho[:, None], z[:, None], places[:, 0], places[:, 1])
        return potential @ charges, radial @ charges, axial @ charges
