"""How finely charges are solved."""

from dataclasses import dataclass
from typing import Any

from apt_evap._common.validation import check_count, check_number


def check_angle(angle: Any) -> float:
    """Return an opening angle [rad] from 0 to 1.5, or say what is wrong (ValueError)."""
    return check_number(angle, "opening_angle", at_least=0, at_most=1.5, unit="rad")


@dataclass(frozen=True)
class ChargeSettings:
    """How finely the charges are solved.

    Lengths are in nearest neighbour distances d_nn of the specimen.

    Parameters
    ----------
    opening_angle : float
        Full angle under which a cell of the octree stands for its atoms [rad]. 0.4 keeps charges within 3e-4 of what
        direct sums give (largest difference on a tip of R = 12 a).
    patch_radius : float
        Charges are solved within this distance of a hole [d_nn]; 8.5 is 6 lattice constants of fcc.
    update_radius : float
        Fields are kept up to date within this distance of a hole [d_nn].
    sweep_interval : int, optional
        Events between two relaxations of the whole surface; by default a 300th of the surface
        atoms there are at the start, but at least 100.
    tolerance : float
        Change of a charge, relative to the mean charge, at which a relaxation between events stops.
    start_tolerance : float
        The same for the first one, which starts from equal charges.
    relaxation_angle : float
        Opening angle of the relaxations between events [rad]: 0.6 keeps charges within 2.2e-4 of direct sums (RMS, on a
        tip of R = 12 a), less than what builds up between two of them.
    """

    opening_angle: float = 0.4
    patch_radius: float = 8.5
    update_radius: float = 18.0
    sweep_interval: int | None = None
    tolerance: float = 3e-3
    start_tolerance: float = 1e-5
    relaxation_angle: float = 0.6

    def __post_init__(self):
        check_angle(self.opening_angle)
        check_number(self.patch_radius, "patch_radius", at_least=1.5, at_most=30, unit="d_nn")
        check_number(self.update_radius, "update_radius", at_least=self.patch_radius, at_most=40, unit="d_nn")
        check_number(self.relaxation_angle, "relaxation_angle", at_least=self.opening_angle, at_most=1.5, unit="rad")
        check_number(self.tolerance, "tolerance", above=0, at_most=1)
        check_number(self.start_tolerance, "start_tolerance", above=0, at_most=1)
        if self.sweep_interval is not None:
            check_count(self.sweep_interval, "sweep_interval", at_least=1)
