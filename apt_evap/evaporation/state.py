"""State of an emitter, from which its charged surface is rebuilt bit by bit."""

from dataclasses import dataclass, field
from typing import Any

import numpy as np


@dataclass(frozen=True, eq=False)
class EmitterState:
    """State from which a surface after its last relaxation is rebuilt bit by bit; see `Emitter.restore`.

    Parameters
    ----------
    sites : ndarray of int64, shape (n,)
        Atoms that had evaporated by then, in their order.
    charges : ndarray, shape (m,)
        Start values of that relaxation for the surface atoms, in the order of their indices [e].
    isolated : ndarray of int64, shape (k,)
        Surface atoms without neighbours, which keep their last normal.
    isolated_normals : ndarray, shape (k, 3)
        Their normals.
    extensions : tuple of int
        Number of evaporated atoms at each extension of the shell.
    tolerance : float
        Tolerance of the relaxation, as in `ChargeSettings`.
    opening_angle : float
        Opening angle of the relaxation [rad].
    clipped, unsettled : int
        As in `Emitter.counts`.
    rule_state : dict
        Further state of the charging rule: for Robin the "potential_point" [nm], shape (3,); for
        ConstantPotential the "self_term" [1/nm] and the "area" per atom [nm^2].
    voltage_factor : float
        Voltage of the control divided by that of the charges, after the relaxation.
    """

    sites: np.ndarray
    charges: np.ndarray
    isolated: np.ndarray
    isolated_normals: np.ndarray
    extensions: tuple
    tolerance: float
    opening_angle: float
    clipped: int
    unsettled: int
    rule_state: dict[str, Any] = field(default_factory=dict)
    voltage_factor: float = 1.0
