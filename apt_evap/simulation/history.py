"""The history of a run: charges and ions at each check of the monitor, and the cap at each relaxation."""

from collections.abc import Iterable
from typing import NamedTuple

import numpy as np

from apt_evap._common.short_repr import short_repr
from apt_evap.evaporation.cap import Cap


def _joined(parts):
    """Columns of the joined parts, without repeated rows."""
    columns = [np.concatenate(pieces) for pieces in zip(*parts, strict=True)]
    rows = np.column_stack(columns)
    first = {row.tobytes(): number for number, row in reversed(list(enumerate(rows)))}
    return columns if len(first) == len(rows) else [column[sorted(first.values())] for column in columns]


class History(NamedTuple):
    """Results of each check of the monitor, for the charges and for the ions since the previous check.

    Parameters
    ----------
    ions : ndarray of int64, shape (k,)
        Number of evaporated ions at the check.
    residual_rms, residual_max : ndarray, shape (k,)
        RMS and largest residual of the sampled charges, relative to the mean charge; see `charge_residuals`.
    missed, never_left, flagged : ndarray, shape (k,)
        Fractions of the flown ions since the previous check that missed the detector, that never left (both for the
        first perturbation of the run), and that are flagged for inexact responses.
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

    def __repr__(self) -> str:
        return short_repr(self)

    @classmethod
    def empty(cls) -> "History":
        """History without a check."""
        return cls(np.empty(0, np.int64), *(np.empty(0) for _ in cls._fields[1:]))

    @classmethod
    def join(cls, parts: "Iterable[History]") -> "History":
        """Join the parts of a history in their order; equal rows count once, as parts of a run share its history."""
        return cls(*_joined([cls.empty(), *parts]))


class CapHistory(NamedTuple):
    """The cap of the surface after each relaxation of the charges, at the simulated voltage.

    Parameters
    ----------
    ions : ndarray of int64, shape (k,)
        Number of evaporated ions at the relaxation.
    fields : ndarray, shape (k,)
        Mean field of the surface atoms within 45 degrees of the axis [V/nm].
    ratios : ndarray, shape (k,)
        Mean ratio of their fields to their evaporation fields.
    radii : ndarray, shape (k,)
        Radius of the sphere through these atoms [nm].
    apexes : ndarray, shape (k,)
        z of the top of this sphere [nm].
    """

    ions: np.ndarray
    fields: np.ndarray
    ratios: np.ndarray
    radii: np.ndarray
    apexes: np.ndarray

    def __repr__(self) -> str:
        return short_repr(self)

    @classmethod
    def empty(cls) -> "CapHistory":
        """History without a relaxation."""
        return cls(np.empty(0, np.int64), *(np.empty(0) for _ in cls._fields[1:]))

    @classmethod
    def join(cls, parts: "Iterable[CapHistory]") -> "CapHistory":
        """Join the parts of a history in their order; equal rows count once, as parts of a run share its history."""
        return cls(*_joined([cls.empty(), *parts]))

    @classmethod
    def of(cls, ion: int, cap: Cap | None) -> "CapHistory":
        """History of one relaxation before the ion with this number; without a cap, empty."""
        if cap is None:
            return cls.empty()
        return cls(np.array([ion], np.int64), *(np.array([value]) for value in cap))
