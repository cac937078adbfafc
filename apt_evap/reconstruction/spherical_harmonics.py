"""Transform between fields on a sphere and their spherical harmonics, with gradients along the surface."""

from __future__ import annotations

import numpy as np
import scipy
from numpy.typing import NDArray

from apt_evap._common.types import Floats

Coefficients = NDArray[np.complex128]
"""Coefficients of real fields by orthonormal harmonics, indexed [..., m, l], with m >= 0; zero for l < m."""


class SphericalTransform:
    """Fields on a grid of polar angles and azimuths, and their coefficients.

    The polar angles are the nodes of Gauss and Legendre, so that products of two harmonics are integrated exactly.
    Inside the field of view nothing is special if it lies at the equator of the grid, where the cells are squares.

    Parameters
    ----------
    degree : int
        Largest degree.
    """

    def __init__(self, degree: int) -> None:
        self.degree = degree
        rows = int(1.5 * degree) + 2
        cosines, weights = np.polynomial.legendre.leggauss(rows)
        cosines, weights = cosines[::-1], weights[::-1]  # polar angles increase
        self.polar = np.arccos(cosines)
        self.azimuths = 2 * np.pi * np.arange(2 * rows) / (2 * rows)
        self.solid_angles = np.repeat(weights[:, None] * (np.pi / rows), 2 * rows, axis=1)  # of the nodes [sr]
        self.degrees = np.arange(degree + 1)
        values, slopes = _legendre(degree, cosines)
        self._values, self._slopes = values, slopes  # [m, polar angle, l]
        self._weighted = np.ascontiguousarray((values * weights[:, None] * (np.pi / rows)).transpose(0, 2, 1))
        self._sines = np.sqrt(1 - cosines**2)

    @property
    def shape(self) -> tuple[int, int]:
        """Number of polar angles and of azimuths."""
        return len(self.polar), len(self.azimuths)

    @property
    def spacing(self) -> float:
        """Distance of the polar angles, which differ from equal ones by 1e-3 of it; that of the azimuths too [rad]."""
        return float(np.pi / (len(self.polar) + 0.5))

    @property
    def nodes(self) -> Floats:
        """Directions of the nodes, shape (polar angles, azimuths, 3)."""
        polar, azimuth = np.meshgrid(self.polar, self.azimuths, indexing="ij")
        sine = np.sin(polar)
        return np.stack([sine * np.cos(azimuth), sine * np.sin(azimuth), np.cos(polar)], axis=-1)

    def analysis(self, fields: Floats) -> Coefficients:
        """Coefficients of fields, shape (k, polar angles, azimuths): shape (k, m, l)."""
        waves = scipy.fft.rfft(fields, axis=-1)[..., : self.degree + 1]
        return self._multiply(self._weighted, np.ascontiguousarray(waves.transpose(0, 2, 1)))

    def synthesis(self, coefficients: Coefficients) -> Floats:
        """Fields of coefficients, shape (k, m, l): shape (k, polar angles, azimuths)."""
        return self._fields(self._multiply(self._values, coefficients))

    def fields_and_gradient(self, coefficients: Coefficients, inclined: Coefficients) -> tuple[Floats, Floats]:
        """Fields of k coefficients; gradients of j others along polar angle and azimuth, shape (j, 2, ...)."""
        k, j = len(coefficients), len(inclined)
        along = 1j * self.degrees[:, None] * inclined  # d/d(azimuth)
        waves = self._multiply(self._values, np.concatenate([coefficients, along]))
        waves[k:] /= self._sines
        waves = np.concatenate([waves, self._multiply(self._slopes, inclined)])
        fields = self._fields(waves)
        return fields[:k], np.stack([fields[k + j :], fields[k : k + j]], axis=1)

    def _multiply(self, matrices, columns):
        """Product with one matrix for each m, as real numbers: shape (k, m, n) to (k, m, rows)."""
        k, orders, n = columns.shape
        right = np.ascontiguousarray(columns.transpose(1, 2, 0)).view(np.float64).reshape(orders, n, 2 * k)
        product = np.matmul(matrices, right)  # small matrices: by one thread
        return product.view(np.complex128).transpose(2, 0, 1)

    def _fields(self, waves):
        """Fields of the waves along the azimuth, shape (k, m, polar angles)."""
        n = len(self.azimuths)
        return scipy.fft.irfft(waves.transpose(0, 2, 1) * n, n=n, axis=-1)


def _legendre(degree, cosines):
    """Orthonormal associated Legendre functions and their slopes over the polar angle, indexed [m, polar angle, l]."""
    sines = np.sqrt(1 - cosines**2)
    values = np.zeros((degree + 1, degree + 1, len(cosines)))  # [l, m]
    values[0, 0] = np.sqrt(1 / (4 * np.pi))
    for m in range(degree + 1):
        if m:
            values[m, m] = -np.sqrt((2 * m + 1) / (2 * m)) * sines * values[m - 1, m - 1]
        if m < degree:
            values[m + 1, m] = np.sqrt(2 * m + 3) * cosines * values[m, m]
        for l in range(m + 2, degree + 1):
            first = np.sqrt((4 * l * l - 1) / (l * l - m * m))
            second = np.sqrt(((l - 1) ** 2 - m * m) / (4 * (l - 1) ** 2 - 1))
            values[l, m] = first * (cosines * values[l - 1, m] - second * values[l - 2, m])
    slopes = np.zeros_like(values)
    for m in range(degree + 1):
        for l in range(m, degree + 1):
            below = np.sqrt((2 * l + 1) / (2 * l - 1) * (l * l - m * m)) * values[l - 1, m] if l > m else 0.0
            slopes[l, m] = (l * cosines * values[l, m] - below) / sines
    return (np.ascontiguousarray(table.transpose(1, 2, 0)) for table in (values, slopes))
