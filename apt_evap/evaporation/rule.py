"""Charging rules: the distribution of the charge over the surface."""

from collections.abc import Callable
from typing import ClassVar, Protocol

import apt_evap._core.constant_potential as constant_potential
import apt_evap._core.robin as robin
from apt_evap._common.codec import choice, count, number, settings
from apt_evap._common.types import Floats
from apt_evap._common.validation import short_text
from apt_evap._core.rule import ChargingRule, PythonRule
from apt_evap.specimen.tip import Tip


class Rule(Protocol):
    """Interface of a charging rule in Python; the compiled ones implement ``_core/rule.pxd``.

    Both methods work on arrays of surface atoms. The package keeps the field of all other atoms at each atom, rebuilds
    the tree, and updates the surroundings of a patch.
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
            Start values [e].
        field_of : callable
            Takes charges (n,), returns the field of all other atoms at each atom: ndarray of shape (n, 3) [e/nm^2].
        potential : float
            Potential of the specimen divided by the Coulomb constant [e/nm].
        tolerance : float
            Largest relative change of a charge at which to stop.

        Returns
        -------
        charges : ndarray, shape (n,)
            Charges [e], >= 0.
        area : float
            Area s per surface atom [nm^2]: the field just outside an atom is 4 pi k_e q / s.
        """
        ...

    def solve_patch(self, positions: Floats, normals: Floats, charges: Floats, field: Floats) -> Floats:
        """Return new charges of the atoms around a hole, at fixed charges of all others.

        Parameters
        ----------
        positions, normals : ndarray, shape (m, 3)
            Atoms of the patch [nm] and outward unit normals.
        charges : ndarray, shape (m,)
            Previous charges [e]; 0 for newly exposed atoms.
        field : ndarray, shape (m, 3)
            Field of all other surface atoms with these charges, including the patch [e/nm^2].

        Returns
        -------
        ndarray, shape (m,)
            New charges [e]; negative charges are set to 0 and counted.
        """
        ...


class CompiledRule(Protocol):
    """Interface of a charging rule with a compiled class, which implements ``_core/rule.pxd``.

    Its attributes `RELAXATION_TOLERANCE`, `RELAXATION_SHARE` and `WHOLE_INTERVAL`, if it has them, are defaults of
    `ChargeSettings`; otherwise those of `Robin`.
    """

    def kernel(self, tip: Tip) -> ChargingRule:
        """Return a new compiled rule for a specimen; it stores data of the surface, so it cannot be shared."""
        ...


@settings
class Robin:
    """Robin's iteration, for the whole surface and for the patch around a hole.

    The charge of an atom on a conductor is induced by the field of all other atoms along its normal. The iteration does
    not fix the total charge: this follows from the potential at a point inside the specimen. The point moves down the
    axis when the surface comes close to it.

    Notes
    -----
    ``q_i <- (s/2 pi) sum_{k != i} q_k n_i . (r_i - r_k)/|r_i - r_k|^3``, where s, the area per atom, is chosen in every
    sweep such that the total charge is conserved (Robin, 1886; Rolland et al., Microsc. Microanal. 21, 1649, 2015).

    Examples
    --------
    >>> tip = ae.Tip("Ni", apex_radius=2.0, axis=(1, 1, 1))
    >>> run = ae.Simulation(tip, voltage=1000.0, rule=ae.Robin(tolerance=1e-6)).run(100)
    >>> print(f"{np.median(run.charges):.2f} e")
    2.02 e
    """

    RELAXATION_TOLERANCE: ClassVar[float] = 6e-3
    """Largest change of a charge at which a relaxation between events stops, relative to the mean charge.

    Measured just before a relaxation, where errors are largest: those with 3e-3 within 7 % (Ni[111], R = 40 a and 80 a,
    which chose it; 1.2 to 1.3 times with 1.2e-2), and within 3 % with fields at exposed atoms from 0.6 rad, too
    (W[110], R = 35 a, and Al[001], R = 30 a, which chose nothing). Relaxations are 1.04 to 1.7 times as fast.
    """

    RELAXATION_SHARE: ClassVar[int] = 300
    """Surface atoms over the events between two relaxations."""

    WHOLE_INTERVAL: ClassVar[int] = 10
    """Relaxations until the whole surface is relaxed.

    Measured (Ni[111], R = 40 a, six places): with a share of 200 and an interval of 7, as for `ConstantPotential`, an
    event takes 0.90 of the time, but charges deviate by 3.6e-4 (RMS) instead of 2.7e-4 just after a relaxation, and by
    9.2e-4 instead of 7.1e-4 just before one.
    """

    tolerance: float = number(
        "Largest change of a charge in the last iteration of a patch, relative to the mean charge of the patch. "
        "Measured (R = 40 a): errors of charges and fields are those with 1e-5 to two digits.",
        default=1e-4,
        above=0,
        at_most=1,
    )
    window: int = count(
        "Number of earlier sweeps in the Anderson mixing of the whole surface (Anderson, J. ACM 12, 547, 1965); 0 is "
        "Robin's plain iteration.",
        default=8,
        at_most=32,
    )

    def kernel(self, tip: Tip) -> ChargingRule:
        """Return the compiled rule for a specimen; the potential is applied at `tip.potential_point`."""
        kernel = robin.Robin(self.tolerance, self.window)
        kernel.begin(tip.potential_point)
        return kernel


CHARGES = ("points", "gaussian")
"""Shapes of the charges of `ConstantPotential`."""

LAW_SEES = ("charge", "others")
"""Fields that a law can see with `ConstantPotential`."""


@settings
class ConstantPotential:
    """Charges at which every surface atom has the potential of the specimen, as in a conductor.

    Notes
    -----
    ``sum_{j != i} q_j u(r_ij) + S q_i = V / k_e``, with ``u(r) = 1/r`` for points and ``u(r) = erf(eta r/sqrt 2)/r``,
    ``eta = S sqrt(pi/2)``, for Gaussian charges. Charges may be negative at atoms deep below a step.
    :doc:`/charging_rules` derives the self term.

    Examples
    --------
    >>> tip = ae.Tip("Ni", apex_radius=2.0, axis=(1, 1, 1))
    >>> run = ae.Simulation(tip, voltage=1000.0, rule=ae.ConstantPotential()).run(100)
    >>> print(f"{np.median(run.charges):.2f} e")
    2.42 e
    """

    RELAXATION_TOLERANCE: ClassVar[float] = 6e-3
    """As of `Robin`. Between relaxations, potentials of small tips (R = 2.5 nm, 150 to 337 events) deviate by 0.3 to
    1.0 V of 1000 V."""

    RELAXATION_SHARE: ClassVar[int] = 200
    WHOLE_INTERVAL: ClassVar[int] = 7
    """As of `Robin`. Errors grow with the number of events since the whole surface was relaxed, and relaxations of
    parts mend little of them: charges deviate by 7e-4 of their mean (RMS) just after one, and by 9e-4 just before.

    Measured (six to eight places each) with a share of 300, an interval of 10 and 8e-3, and with these numbers, charges
    after and before a relaxation, then the fields that the law sees before one: Ni[111], R = 24 a, which chose them,
    8.0e-4 and 6.4e-4, 1.01e-3 and 9.1e-4, 3.0e-4 and 3.2e-4; W[110], R = 30 a, 8.5e-4 and 7.5e-4, 9.9e-4 and 1.01e-3,
    3.0e-4 and 3.4e-4; Al[001], R = 26 a, 8.3e-4 and 6.9e-4, 9.2e-4 and 9.1e-4, 3.0e-4 and 3.2e-4. Events take 0.86,
    0.93 and 0.85 of the time.
    """

    self_term: float | None = number(
        "Potential of an atom by its own charge 1. By default 3.92 / sqrt(s), with the area s per atom of the first "
        "surface: then the electrical surface of a flat lattice passes through its nuclei. Solutions raise a "
        "ValueError if it is too small.",
        default=None,
        above=0,
        at_most=1000,
        unit="1/nm",
    )
    charges: str = choice("Point charges, or Gaussian charges with the same self term.", CHARGES, default="points")
    law_field: str = choice(
        'Field that a law sees: "others", twice the normal field of all other charges at the place of an atom, whose '
        'lines are where measured ones are, or "charge", 4 pi k_e q / s of its own charge. With `Robin` the two are '
        "equal.",
        LAW_SEES,
        default="others",
    )
    tolerance: float = number(
        "Largest residual of the charges of a patch, relative to the mean charge of the patch. Measured (R = 40 a): "
        "errors of charges and fields are those with 1e-5 to two digits; with 3e-4 they are up to 1.15 times larger.",
        default=1e-4,
        at_least=1e-6,
        at_most=1,
    )

    def kernel(self, tip: Tip) -> ChargingRule:
        """Return the compiled rule for a specimen."""
        return constant_potential.ConstantPotential(
            self.self_term or 0.0, self.charges == "gaussian", self.law_field == "others", self.tolerance
        )


RULES = (Robin, ConstantPotential)
"""The built-in charging rules, the default first."""


def check_rule(rule: object) -> None:
    """Raise a ValueError if `rule` is not a charging rule."""
    methods = {name for name in ("kernel", "solve", "solve_patch") if callable(getattr(rule, name, None))}
    if isinstance(rule, type) or not ("kernel" in methods or {"solve", "solve_patch"} <= methods):
        expected = "a charging rule such as Robin(), or an object with solve and solve_patch"
        raise ValueError(f"rule must be {expected}, got {short_text(rule)}")


def relaxations_of(rule: Rule | CompiledRule) -> tuple[float, int, int]:
    """Return tolerance, share and whole interval of the relaxations of a rule; those of `Robin` without its own."""
    tolerance = getattr(rule, "RELAXATION_TOLERANCE", Robin.RELAXATION_TOLERANCE)
    share = getattr(rule, "RELAXATION_SHARE", Robin.RELAXATION_SHARE)
    return tolerance, share, getattr(rule, "WHOLE_INTERVAL", Robin.WHOLE_INTERVAL)


def kernel_of(rule: Rule | CompiledRule, tip: Tip) -> ChargingRule:
    """Return the compiled rule for a specimen; for a rule in Python, one that calls it."""
    make = getattr(rule, "kernel", None)
    return PythonRule(rule) if make is None else make(tip)
