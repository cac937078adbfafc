"""Accuracy of the charges."""

from dataclasses import dataclass
from typing import Any

from apt_evap._common.validation import check_count, check_number


def check_angle(angle: Any) -> float:
    """Return an opening angle [rad] from 0 to 1.5; ValueError otherwise."""
    return check_number(angle, "opening_angle", at_least=0, at_most=1.5, unit="rad")


@dataclass(frozen=True)
class ChargeSettings:
    """Accuracy of the charges.

    Lengths are in nearest neighbour distances d_nn of the specimen.

    Parameters
    ----------
    opening_angle : float
        Largest full angle of an octree cell that replaces its atoms [rad]. Measured: with 0.4, charges deviate by at
        most 3e-4 from those of direct sums (tip of R = 12 a).
    patch_radius : float
        Charges are recomputed within this distance of a hole [d_nn]; 8.5 is 6 lattice constants of fcc.
    update_radius : float
        Fields are updated within this distance of a hole [d_nn].
    sweep_interval : int, optional
        Events between two relaxations of the whole surface; by default 1/300 of the initial number of surface atoms,
        but at least 100.
    tolerance : float, optional
        Largest change of a charge, relative to the mean charge, at which a relaxation between events stops; by default
        that of the rule (`RELAXATION_TOLERANCE` of `Robin` or `ConstantPotential`).
    start_tolerance : float
        The same for the first relaxation, which starts from equal charges.
    relaxation_angle : float
        Opening angle of the relaxations between events [rad]. Measured: with 0.6, charges deviate by 2.2e-4 (RMS) from
        those of direct sums (tip of R = 12 a), less than the error that accumulates between two relaxations.
    """

    opening_angle: float = 0.4
    patch_radius: float = 8.5
    update_radius: float = 18.0
    sweep_interval: int | None = None
    tolerance: float | None = None
    start_tolerance: float = 1e-5
    relaxation_angle: float = 0.6

    def __post_init__(self):
        check_angle(self.opening_angle)
        check_number(self.patch_radius, "patch_radius", at_least=1.5, at_most=30, unit="d_nn")
        check_number(self.update_radius, "update_radius", at_least=self.patch_radius, at_most=40, unit="d_nn")
        check_number(self.relaxation_angle, "relaxation_angle", at_least=self.opening_angle, at_most=1.5, unit="rad")
        if self.tolerance is not None:
            check_number(self.tolerance, "tolerance", above=0, at_most=1)
        check_number(self.start_tolerance, "start_tolerance", above=0, at_most=1)
        if self.sweep_interval is not None:
            check_count(self.sweep_interval, "sweep_interval", at_least=1)
