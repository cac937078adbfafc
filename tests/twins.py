"""Slow twins of the compiled core in plain NumPy: the same physics, no tree, no lists, no patches."""

from itertools import pairwise

import numpy as np
from scipy.spatial import cKDTree
from scipy.special import erf


def potential(points, atoms, charges):
    """Sum q/r at the points, shape (m,)."""
    return np.array([(charges / np.linalg.norm(point - atoms, axis=1)).sum() for point in points])


def field(points, atoms, charges):
    """Sum q r/r^3 at the points, shape (m, 3); an atom at the very place of a point does not act on it."""
    out = np.empty((len(points), 3))
    for i, point in enumerate(points):
        d = point - atoms
        r2 = np.einsum("ij,ij->i", d, d)
        with np.errstate(divide="ignore", invalid="ignore"):
            out[i] = np.where(r2 > 1e-12, charges / r2**1.5, 0.0) @ d
    return out


def morton_keys(positions):
    """Key of each position: its octants in the bounding cube, 21 levels of three bits, digit by digit."""
    low = positions.min(axis=0)
    edge = max(float((positions.max(axis=0) - low).max()), 1e-9)
    grid = ((positions - low) * ((2**21 - 1) / edge)).astype(np.int64)
    keys = np.zeros(len(positions), np.uint64)
    for level in range(20, -1, -1):
        octant = (grid >> level & 1) @ [4, 2, 1]
        keys = keys * np.uint64(8) + octant.astype(np.uint64)
    return keys


def split(keys, leaf_size, first=0, level=20):
    """Nested [first, last, children] of sorted keys; a range that shares its octant goes one level down."""
    last = first + len(keys)
    octants = keys >> np.uint64(3 * max(level, 0)) & np.uint64(7)
    if len(keys) <= leaf_size or level < 0:
        return [first, last, []]
    cuts = np.searchsorted(octants, np.arange(9))
    parts = [(a, b) for a, b in pairwise(cuts) if b > a]
    if len(parts) == 1:
        return split(keys, leaf_size, first, level - 1)
    return [first, last, [split(keys[a:b], leaf_size, first + a, level - 1) for a, b in parts]]


def flat(node, parent=-1, rows=None):
    """Rows (first, last, parent, skip) of a nested node, in preorder."""
    rows = [] if rows is None else rows
    number = len(rows)
    rows.append([node[0], node[1], parent, 0])
    for child in node[2]:
        flat(child, number, rows)
    rows[number][3] = len(rows)
    return rows


def moments(atoms, charges):
    """Charge, centre of charge and traceless quadrupole sum q (3 d d - d^2), the ten numbers of a cell."""
    total = charges.sum()
    centre = charges @ atoms / total
    d = atoms - centre
    q = 3 * np.einsum("i,ij,ik->jk", charges, d, d) - np.eye(3) * (charges @ np.einsum("ij,ij->i", d, d))
    return np.array([*centre, total, q[0, 0], q[0, 1], q[0, 2], q[1, 1], q[1, 2], q[2, 2]])


class Surface:
    """Surface atoms by the centre of mass of their neighbours, computed by a k-d tree at every question."""

    def __init__(self, positions, radius, threshold, support):
        self.positions, self.radius, self.threshold, self.support = positions, radius, threshold, support
        self.alive = np.ones(len(positions), bool)

    def offsets(self):
        """Mean offset of the neighbours of each atom, (n, 3), and their number, (n,); 0 for atoms taken away."""
        left = np.flatnonzero(self.alive)
        pairs = cKDTree(self.positions[left]).query_pairs(self.radius, output_type="ndarray")
        pairs = left[np.concatenate([pairs, pairs[:, ::-1]])]
        step = self.positions[pairs[:, 1]] - self.positions[pairs[:, 0]]
        n = len(self.positions)
        count = np.bincount(pairs[:, 0], minlength=n)
        total = np.stack([np.bincount(pairs[:, 0], weights=step[:, axis], minlength=n) for axis in range(3)], axis=1)
        return total / np.maximum(count, 1)[:, None], count

    def exposed(self):
        """Who is at the surface now, bool (n,)."""
        mean, count = self.offsets()
        far = (np.linalg.norm(mean, axis=1) > self.threshold) | (count == 0)
        return far & self.alive & ~self.support


def robin(positions, normals, tolerance=1e-12, most_sweeps=400):
    """Charges (sum n) and area per atom of Robin's iteration, with the full matrix in float64."""
    n = len(positions)
    matrix = np.empty((n, n))
    for i in range(n):
        d = positions[i] - positions
        r2 = np.einsum("ij,ij->i", d, d)
        r2[i] = np.inf
        matrix[i] = (d @ normals[i]) / r2**1.5
    charges = np.ones(n)
    for _ in range(most_sweeps):
        flux = matrix @ charges
        new = flux * (n / flux.sum())
        change = np.abs(new - charges).max()
        charges = new
        if change < tolerance:
            break
    return charges, 2 * np.pi * n / (matrix @ charges).sum()


def constant_potential(positions, self_term, eta=None):
    """Charges at which every atom has the potential 1 [e/nm], by the dense matrix; eta [1/nm] of Gaussian charges."""
    d = np.linalg.norm(positions[:, None] - positions, axis=2)
    np.fill_diagonal(d, 1.0)
    matrix = (1.0 if eta is None else erf(eta * d / np.sqrt(2))) / d
    np.fill_diagonal(matrix, self_term)
    return np.linalg.solve(matrix, np.ones(len(positions)))


def verlet(acceleration, position, velocity, centre, reach, factor, first_length):
    """Velocity Verlet with dt = factor |v|/|a|, the first step by a length (Shaikh et al., arXiv 2509.13744).

    Returns position, velocity, time and the number of steps at the first step beyond `reach` from `centre`.
    """
    x, v, time, steps = np.array(position), np.array(velocity), 0.0, 0
    a = acceleration(x)
    while np.linalg.norm(x - centre) < reach:
        dt = factor * np.linalg.norm(v) / np.linalg.norm(a)
        if steps == 0:
            speed = np.linalg.norm(v)
            dt = 2 * first_length / (speed + np.sqrt(speed**2 + 2 * first_length * np.linalg.norm(a)))
        x = x + dt * (v + 0.5 * dt * a)
        new = acceleration(x)
        v = v + 0.5 * dt * (a + new)
        a, time, steps = new, time + dt, steps + 1
    return x, v, time, steps


def hyperbola(strength, position, velocity, radius):
    """Where and when a repelled particle, a = strength r/r^3, passes `radius` on its way out: (3,), (3,), time.

    Closed form: r = A (e cosh F + 1), t = sqrt(A^3/strength) (e sinh F + F), with A = strength/(2 energy) (Landau and
    Lifshitz, Mechanics, section 15). A start with an inward velocity has F < 0.
    """
    r0 = np.linalg.norm(position)
    energy = 0.5 * velocity @ velocity + strength / r0
    momentum = np.linalg.norm(np.cross(position, velocity))
    a = strength / (2 * energy)
    e = np.sqrt(1 + 2 * energy * momentum**2 / strength**2)
    anomaly = [np.arccosh(max(1.0, (r / a - 1) / e)) for r in (r0, radius)]
    if position @ velocity < 0:
        anomaly[0] = -anomaly[0]
    time = np.sqrt(a**3 / strength) * (e * np.sinh(anomaly[1]) + anomaly[1] - e * np.sinh(anomaly[0]) - anomaly[0])
    outward = position / r0
    sideways = velocity - (velocity @ outward) * outward
    sideways = sideways / (np.linalg.norm(sideways) or 1.0)
    # angle from the axis of the hyperbola
    polar = [2 * np.arctan(np.sqrt((e - 1) / (e + 1)) * np.tanh(f / 2)) if e > 1 else 0.0 for f in anomaly]
    polar = [np.arctan2(np.sqrt(e**2 - 1) * np.sinh(f), e + np.cosh(f)) for f in anomaly]
    turn = polar[1] - polar[0]
    direction = np.cos(turn) * outward + np.sin(turn) * sideways
    across = -np.sin(turn) * outward + np.cos(turn) * sideways
    radial = np.sqrt(max(0.0, 2 * (energy - strength / radius) - (momentum / radius) ** 2))
    return radius * direction, radial * direction + momentum / radius * across, time


def potential_of_others(atoms, charges):
    """Sum q/r over all other atoms at each atom, shape (n,)."""
    out = np.empty(len(atoms))
    for i, atom in enumerate(atoms):
        r = np.linalg.norm(atoms - atom, axis=1)
        r[i] = np.inf
        out[i] = (charges / r).sum()
    return out
