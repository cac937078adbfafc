"""Ions that are lost because others of the same kind arrive in the dead time of the detector."""

import math
from dataclasses import dataclass

import numpy as np

from apt_evap._common.types import Floats, Integers
from apt_evap.spectra.composition import Amounts, Composition

FEWEST_OF_ISOTOPES = 200.0
"""Ions of the minor isotopes of an ion among single ions, and among those of pulses with several."""


@dataclass(frozen=True)
class DeadTimeLoss:
    """Losses by dead time, from the isotopes of single ions against those of pulses with several.

    Parameters
    ----------
    lost : dict of str to tuple of float
        By ion: part of the ions in pulses with several that is lost, and its standard error.
    shift : dict of str to float
        By element: at.% with these ions less at.% without them.
    error : dict of str to float
        Standard errors of the composition [at.%].
    """

    lost: dict[str, tuple[float, float]]
    shift: dict[str, float]
    error: dict[str, float]

    @property
    def matters(self) -> bool:
        """Whether the losses are above three of their errors, and move the composition by more than its error."""
        clear = any(part > 3 * error for part, error in self.lost.values())
        # an element alone has 100 at.% without an error, and a shift by rounding
        return clear and any(abs(value) > max(self.error[element], 1e-6) for element, value in self.shift.items())

    def __str__(self) -> str:
        if not self.lost:
            return "dead time: no ion has enough ions of two isotopes, alone and with others, to measure its losses"
        parts = ", ".join(f"{part:.1%} ± {error:.1%} of {name}" for name, (part, error) in self.lost.items())
        text = f"in pulses with several ions, {parts} are lost by the dead time of the detector, as their isotopes show"
        if not self.shift:
            return text
        most = max(self.shift, key=lambda element: self.shift[element])
        verdict = "more than its error" if self.matters else "not beyond the errors"
        moved = f"with these ions there would be {self.shift[most]:.2f} at.% more {most}, {verdict}"
        return f"{text}; the at.% are not corrected for it: {moved}"


def isotope_losses(
    major: int, minor: Integers, single: Floats, multiple: Floats, errors: tuple[Floats, Floats]
) -> tuple[float, float]:
    """Part of the major isotope that is lost among multiples, and its standard error, from peak contents.

    The ratio of the major to the minor isotopes is r among single ions; of multiples, n minor ions belong to r n major
    ones, of which fewer are seen. Minor isotopes seldom come in pairs, so that they are hardly lost.
    """
    ratio = single[major] / single[minor].sum()
    expected = ratio * multiple[minor].sum()
    part = 1 - multiple[major] / expected
    variance = [errors[0][major] / single[major] ** 2, errors[0][minor].sum() / single[minor].sum() ** 2]
    variance += [errors[1][major] / max(multiple[major], 1) ** 2, errors[1][minor].sum() / multiple[minor].sum() ** 2]
    return float(part), float((1 - part) * math.sqrt(sum(variance)))


def losses_of(amounts: Amounts, names: list[str], lost: dict[str, tuple[float, float]], missing: dict[str, float],
              before: Composition) -> DeadTimeLoss:  # fmt: skip
    """Losses with the shift of the composition by the ions that are missing."""
    ions = np.array([number + missing.get(name, 0.0) for number, name in zip(amounts.ions, names, strict=True)])
    after = Amounts(amounts.atoms, ions, amounts.covariance).composition(before.unexplained)
    shift = {element: value - before[element] for element, value in after.at_percent.items() if before.at_percent}
    return DeadTimeLoss(lost, shift, before.error)
