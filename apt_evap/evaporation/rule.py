"""Charging rules: how charge distributes over the surface."""

from collections.abc import Callable
from typing import Any, Protocol

from apt_evap._common.types import Floats
from apt_evap._core.robin import Robin
from apt_evap._core.rule import ChargingRule, PythonRule

__all__ = ["ChargingRule", "Robin", "Rule", "rule_for"]


class Rule(Protocol):
    """Interface of a charging rule in Python; the compiled ones implement ``_core/rule.pxd``.

    Both methods work on surface atoms that are given as arrays. The library keeps the field of all the others on each
    atom, rebuilds its tree, and spreads the changes of a patch over its surroundings.
    """

    def solve(
        self,
        positions: Floats,
        normals: Floats,
        charges: Floats,
        field_of: Callable[[Floats], Floats],
        potential: float,
        tolerance: float,
    ) -> tuple[Floats, float]:
        """Return the charges of the whole surface at its potential, and the area per atom.

        Parameters
        ----------
        positions, normals : ndarray, shape (n, 3)
            Surface atoms [nm] and outward unit normals.
        charges : ndarray, shape (n,)
            What to start from [e].
        field_of : callable
            Field of all the others on each atom for some charges (n,): ndarray of shape (n, 3) [e/nm^2].
        potential : float
            Potential of the specimen over the Coulomb constant [e/nm].
        tolerance : float
            Largest relative change of a charge at which to stop.

        Returns
        -------
        charges : ndarray, shape (n,)
            Charges [e], none negative.
        area : float
            Surface s per atom [nm^2]: the field just outside an atom is 4 pi k_e q / s.
        """
        ...

    def solve_patch(self, positions: Floats, normals: Floats, charges: Floats, field: Floats) -> Floats:
        """Return new charges of the atoms around a hole while all others are held.

        Parameters
        ----------
        positions, normals : ndarray, shape (m, 3)
            Atoms of the patch [nm] and outward unit normals.
        charges : ndarray, shape (m,)
            Their charges before [e]; 0 for those that came to the surface.
        field : ndarray, shape (m, 3)
            Field of all the other atoms of the surface, those of the patch included, with these charges [e/nm^2].

        Returns
        -------
        ndarray, shape (m,)
            New charges [e]; negative ones are set to 0 and counted.
        """
        ...


def rule_for(rule: Any) -> ChargingRule:
    """Return a charging rule of the core that has seen no surface: a new `Robin` for None, a wrapper for one in Python.

    Raises
    ------
    ValueError
        If it is not a charging rule.
    """
    if rule is None:
        return Robin()
    if isinstance(rule, ChargingRule):
        return rule.fresh()
    if all(callable(getattr(rule, name, None)) for name in ("solve", "solve_patch")):
        return PythonRule(rule)
    raise ValueError(
        f"rule must be a charging rule such as Robin(), or an object with solve and solve_patch, got {rule!r:.80}"
    )
