"""The state of an emitter: what makes its charged surface again, bit by bit."""

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True, eq=False)
class EmitterState:
    """All that makes a surface again, bit by bit, as its last relaxation left it; see `Emitter.restore`.

    Parameters
    ----------
    sites : ndarray of int64, shape (n,)
        Atoms that had left by then, in their order.
    charges : ndarray, shape (m,)
        Charges from which that relaxation started, of the surface atoms in the order of their numbers [e].
    lonely : ndarray of int64, shape (k,)
        Surface atoms that no neighbour pulls, which keep the normal they had.
    lonely_normals : ndarray, shape (k, 3)
        These normals.
    potential_point : tuple of float
        Point that has the potential [nm].
    deepened : tuple of int
        Numbers of atoms that had left whenever more of the specimen came to be held.
    tolerance : float
        Of the relaxation; as in `ChargeSettings`.
    opening_angle : float
        Of the relaxation [rad].
    clipped, unsettled : int
        As in `Emitter.counts`.
    """

    sites: np.ndarray
    charges: np.ndarray
    lonely: np.ndarray
    lonely_normals: np.ndarray
    potential_point: tuple
    deepened: tuple
    tolerance: float
    opening_angle: float
    clipped: int
    unsettled: int
