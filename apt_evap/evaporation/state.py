"""The state of an emitter: what rebuilds its charged surface, bit by bit."""

from dataclasses import dataclass, field
from typing import Any

import numpy as np


@dataclass(frozen=True, eq=False)
class EmitterState:
    """What rebuilds a surface, bit by bit, as its last relaxation left it; see `Emitter.restore`.

    Parameters
    ----------
    sites : ndarray of int64, shape (n,)
        Atoms that had left by then, in their order.
    charges : ndarray, shape (m,)
        Charges from which that relaxation started, of the surface atoms in the order of their numbers [e].
    lonely : ndarray of int64, shape (k,)
        Surface atoms without neighbours, which keep the normal they had.
    lonely_normals : ndarray, shape (k, 3)
        These normals.
    deepened : tuple of int
        Numbers of atoms that had left whenever more of the specimen came to be held.
    tolerance : float
        Of the relaxation; as in `ChargeSettings`.
    opening_angle : float
        Of the relaxation [rad].
    clipped, unsettled : int
        As in `Emitter.counts`.
    rule_state : dict
        What the charging rule started from besides: for Robin the "potential_point" [nm], shape (3,).
    """

    sites: np.ndarray
    charges: np.ndarray
    lonely: np.ndarray
    lonely_normals: np.ndarray
    deepened: tuple
    tolerance: float
    opening_angle: float
    clipped: int
    unsettled: int
    rule_state: dict[str, Any] = field(default_factory=dict)
