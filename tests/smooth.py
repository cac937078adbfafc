"""Points on smooth surfaces of equal area per point, for which the charge of a conductor is known."""

import numpy as np


def fibonacci(n):
    """Points on the unit sphere, each of the same share of its area (Swinbank and Purser, 2006)."""
    k = np.arange(n) + 0.5
    z, azimuth = 1 - 2 * k / n, np.pi * (1 + np.sqrt(5)) * k
    return np.stack([np.sqrt(1 - z * z) * np.cos(azimuth), np.sqrt(1 - z * z) * np.sin(azimuth), z], axis=1)


def spheroid(n, a, c):
    """Points of equal area on the spheroid of half axes a, a, c, by a Fibonacci spiral, with exact normals."""
    edges = np.linspace(-c, c, 200_001)
    middle = (edges[1:] + edges[:-1]) / 2
    area = np.concatenate([[0], np.cumsum(np.sqrt(1 - (middle / c) ** 2 + (a * middle / c**2) ** 2))])
    k = np.arange(n) + 0.5
    z = np.interp(k / n, area / area[-1], edges)
    radius, azimuth = a * np.sqrt(1 - (z / c) ** 2), np.pi * (1 + np.sqrt(5)) * k
    positions = np.stack([radius * np.cos(azimuth), radius * np.sin(azimuth), z], axis=1)
    normals = positions / [a * a, a * a, c * c]
    return positions, normals / np.linalg.norm(normals, axis=1)[:, None]
