"""Charging rules: how charge distributes over the surface."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

from apt_evap._common.types import Floats
from apt_evap._common.validation import check_count, check_number
from apt_evap._core import robin
from apt_evap._core.rule import ChargingRule, PythonRule
from apt_evap.specimen.tip import Tip


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


class CompiledRule(Protocol):
    """Interface of a charging rule whose work is done by a class of the core, which implements ``_core/rule.pxd``."""

    def kernel(self, tip: Tip) -> ChargingRule:
        """Return the compiled rule for a specimen: a new one, as it keeps what it knows of the surface."""
        ...


@dataclass(frozen=True)
class Robin:
    """Robin's iteration, for the whole surface and for the patch around a hole.

    The charge of an atom on a conductor is what the field of all the others along its normal induces. The iteration
    leaves the total charge free: a point inside the specimen is brought to the potential. It moves down the axis when
    the surface comes close to it.

    Parameters
    ----------
    tolerance : float
        Largest change of a charge in the last iteration of a patch, relative to the mean charge of the patch.
    window : int
        Sweeps before the last that are mixed into the next charges of the whole surface (Anderson, J. ACM 12, 547,
        1965); 0 is Robin's plain iteration.

    Raises
    ------
    ValueError
        If the tolerance is not above 0 and at most 1, or the window not 0 to 32.

    Notes
    -----
    q_i <- (s/2 pi) sum_{k != i} q_k n_i . (r_i - r_k)/|r_i - r_k|^3 with s, the area per atom, set in every sweep so
    that the total charge is kept (Robin, 1886; Rolland et al., Microsc. Microanal. 21, 1649, 2015).
    """

    tolerance: float = 1e-5
    window: int = 8

    def __post_init__(self):
        checked = {
            "tolerance": check_number(self.tolerance, "tolerance", above=0, at_most=1),
            "window": check_count(self.window, "window", at_most=32),
        }
        for name, value in checked.items():
            object.__setattr__(self, name, value)

    def kernel(self, tip: Tip) -> ChargingRule:
        """Return the compiled rule for a specimen; the point inside that has the potential is the tip's."""
        kernel = robin.Robin(self.tolerance, self.window)
        kernel.begin(tip.potential_point)
        return kernel


def check_rule(rule: object) -> None:
    """Refuse what is not a charging rule (ValueError)."""
    methods = {name for name in ("kernel", "solve", "solve_patch") if callable(getattr(rule, name, None))}
    if isinstance(rule, type) or not ("kernel" in methods or {"solve", "solve_patch"} <= methods):
        raise ValueError(
            f"rule must be a charging rule such as Robin(), or an object with solve and solve_patch, got {rule!r:.80}"
        )


def kernel_of(rule: Rule | CompiledRule, tip: Tip) -> ChargingRule:
    """Return the compiled rule for a specimen; that of a rule in Python calls it."""
    make = getattr(rule, "kernel", None)
    return PythonRule(rule) if make is None else make(tip)
