"""The history of a run: what the monitor saw of its charges and ions as it went on."""

from collections.abc import Iterable
from typing import NamedTuple

import numpy as np


class History(NamedTuple):
    """What was seen at each look, and of the ions since the look before.

    Parameters
    ----------
    ions : ndarray of int64, shape (k,)
        Ions that had left by then.
    residual_rms, residual_max : ndarray, shape (k,)
        Of the residuals of the sampled charges, relative to the mean charge; see `charge_residuals`.
    missed, never_left, flagged : ndarray, shape (k,)
        Fractions of the ions since the look before that missed the detector or never left, under the first perturbation
        of the run, and whose responses are flagged as inexact.
    field : ndarray, shape (k,)
        Mean field at which these ions left [V/nm].
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
        """A history without a look."""
        return cls(np.empty(0, np.int64), *(np.empty(0) for _ in cls._fields[1:]))

    @classmethod
    def join(cls, parts: "Iterable[History]") -> "History":
        """Join the parts of one history, in their order, into one."""
        return cls(*(np.concatenate(columns) for columns in zip(cls.empty(), *parts, strict=True)))
