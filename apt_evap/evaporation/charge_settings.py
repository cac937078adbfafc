"""Accuracy of the charges."""

from typing import Any

from apt_evap._common.codec import count, number, settings
from apt_evap._common.validation import check_number


def check_angle(angle: Any) -> float:
    """Return an opening angle [rad] from 0 to 1.5; ValueError otherwise."""
    return check_number(angle, "opening_angle", at_least=0, at_most=1.5, unit="rad")


@settings
class ChargeSettings:
    """Accuracy of the charges.

    Lengths are in nearest neighbour distances d_nn of the specimen.
    """

    opening_angle: float = number(
        "Largest full angle of an octree cell that replaces its atoms. Measured: with 0.4, charges deviate by at most "
        "3e-4 from those of direct sums (tip of R = 12 a).",
        default=0.4,
        at_least=0,
        at_most=1.5,
        unit="rad",
    )
    patch_radius: float = number(
        "Charges are recomputed within this distance of a hole; 8.5 is 6 lattice constants of fcc.",
        default=8.5,
        at_least=1.5,
        at_most=30,
        unit="d_nn",
    )
    update_radius: float = number(
        "Fields are updated within this distance of a hole, at least `patch_radius`.",
        default=18.0,
        above=0,
        at_most=40,
        unit="d_nn",
    )
    sweep_interval: int | None = count(
        "Events between two relaxations. By default the initial number of surface atoms over that of the rule "
        "(`RELAXATION_SHARE` of `Robin` or `ConstantPotential`, 300 or 200), but at least 100.",
        default=None,
        at_least=1,
    )
    tolerance: float | None = number(
        "Largest change of a charge, relative to the mean charge, at which a relaxation between events stops. By "
        "default that of the rule (`RELAXATION_TOLERANCE` of `Robin` or `ConstantPotential`).",
        default=None,
        above=0,
        at_most=1,
    )
    start_tolerance: float = number(
        "The same for the first relaxation, which starts from equal charges.", default=1e-5, above=0, at_most=1
    )
    relaxation_angle: float = number(
        "Opening angle of the relaxations between events, and of the fields at newly exposed atoms; at least "
        "`opening_angle`. Measured: with 0.6, charges deviate by 2.2e-4 (RMS) from those of direct sums (tip of "
        "R = 12 a), less than the error that accumulates between two relaxations.",
        default=0.6,
        at_least=0,
        at_most=1.5,
        unit="rad",
    )
    whole_interval: int | None = count(
        "Relaxations until the whole surface is relaxed. The others solve the atoms within `update_radius` of a hole "
        "since the last one. By default that of the rule (`WHOLE_INTERVAL` of `Robin` or `ConstantPotential`: 10 or "
        "7).",
        default=None,
        at_least=1,
    )
    potential_bound: float = number(
        "With Robin's rule, a relaxation is due before `sweep_interval` if events have changed the potential inside "
        "the specimen by this fraction. The potential is then restored at once by a factor common to all charges. "
        "Measured: needed below R = 20 a; from there on the change within an interval is smaller. 1: never.",
        default=4e-3,
        above=0,
        at_most=1,
    )

    def _check(self):
        check_number(self.update_radius, "update_radius", at_least=self.patch_radius, unit="d_nn")
        check_number(self.relaxation_angle, "relaxation_angle", at_least=self.opening_angle, unit="rad")
