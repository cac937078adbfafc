"""The history of a run: its charges and ions at each check of the monitor."""

from collections.abc import Iterable
from typing import NamedTuple

import numpy as np


class History(NamedTuple):
    """Results of each check of the monitor, for the charges and for the ions since the previous check.

    Parameters
    ----------
    ions : ndarray of int64, shape (k,)
        Number of evaporated ions at the check.
    residual_rms, residual_max : ndarray, shape (k,)
        RMS and largest residual of the sampled charges, relative to the mean charge; see `charge_residuals`.
    missed, never_left, flagged : ndarray, shape (k,)
        Fractions of the ions since the previous check that missed the detector, that never left (both for the first
        perturbation of the run), and that are flagged for inexact responses.
    field : ndarray, shape (k,)
        Mean field at the evaporation of these ions [V/nm].
    """

    ions: np.ndarray
    residual_rms: np.ndarray
    residual_max: np.ndarray
    missed: np.ndarray
    never_left: np.ndarray
    flagged: np.ndarray
    field: np.ndarray

    @classmethod
    def empty(cls) -> "History":
        """History without a check."""
        return cls(np.empty(0, np.int64), *(np.empty(0) for _ in cls._fields[1:]))

    @classmethod
    def join(cls, parts: "Iterable[History]") -> "History":
        """Join the parts of a history in their order."""
        return cls(*(np.concatenate(columns) for columns in zip(cls.empty(), *parts, strict=True)))
