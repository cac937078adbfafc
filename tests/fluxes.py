"""Ions of surfaces whose flux is known."""

import numpy as np


def even_flux(n, rim):
    """Directions of ions of a sphere that recedes evenly, on spirals: fewer fluctuations than random ones."""
    sines = np.sin(rim) * np.sqrt((np.arange(n) * 0.6180339887498949 + 0.5) % 1.0)
    turns = 2 * np.pi * ((np.arange(n) * 0.7548776662466927) % 1.0)
    return np.column_stack([sines * np.cos(turns), sines * np.sin(turns), np.sqrt(1 - sines**2)])
