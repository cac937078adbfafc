"""Composition of a specimen in at.%, with errors of counting and the span over other names of the peaks."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from apt_evap._common.types import Floats

_LEAST_OF_OTHERS = 0.05  # at.%: less of an element that only other names have is not printed
_LIKELIEST = 0.05
"""Likelihood over that of the first explanation, below which another one is in the span and not in the error: it is
outside an interval of 95 %. With all, Co 7.8 of a million ions of a nickel alloy has 0.8 at.% in place of 0.04."""
_LIKELY = 2.0  # chi-squared, with a part of the costs, by which the likelihood of others falls by a factor of e
_NO_CHANGE = 0.2  # of the counting error: less changes that error by 2 % at most
MOST_UNEXPLAINED = 0.1
"""Part of the ions in peaks without an explanation, above which there is no composition."""


@dataclass(frozen=True)
class Composition:
    """Atoms of each element, molecular ions taken apart, without the background.

    Parameters
    ----------
    at_percent : dict of str to float
        By element, the most frequent first [at.%]; empty if `refused`.
    error : dict of str to float
        Standard errors of counting and of the shape of the peaks, and of other names by their likelihood [at.%]; also
        of elements that only other names have, with the counting error of the highest value.
    span : dict of str to tuple of float
        Lowest and highest value where peaks may have other names [at.%], also of elements that only these have; equal
        to the value if no peak has.
    unexplained : float
        Part of the ions in peaks that no ion explains.
    refused : str
        Why there is no composition; "" if there is one.
    without_mass : int
        Number of detected ions without m/n, which are not counted.
    """

    at_percent: dict[str, float]
    error: dict[str, float]
    span: dict[str, tuple[float, float]]
    unexplained: float
    refused: str = ""
    without_mass: int = 0

    def __getitem__(self, element: str) -> float:
        return self.at_percent[element]

    def __str__(self) -> str:
        lines = [f"unexplained: {self.unexplained:.1%} of the ions in peaks"]
        if self.refused:
            return "\n".join([*lines, f"no composition: {self.refused}"])
        for name, value, error, span in self.rows():
            if value:
                lines.append(f"{name}: {value} ± {error} at.%" + (f" ({span} with other names)" if span else ""))
        for element, high in self.perhaps.items():
            lines.append(f"perhaps {element}: 0 to {high:.2f} at.% with other names, ± {self.error[element]:.2f}")
        return "\n".join(lines)

    def rows(self) -> list[tuple[str, str, str, str]]:
        """Rows of a table: element, at.%, error, and the span over other names.

        The value is "" for an element that only other names have, and the span where it is not more than the error.
        """
        rows = []
        for element in [*self.at_percent, *self.perhaps]:
            value, error, (low, high) = self.at_percent.get(element), self.error[element], self.span[element]
            span = f"{low:.2f} to {high:.2f}" if high - low > max(error, 0.005) else ""
            name, number = (f"perhaps {element}", "") if value is None else (element, f"{value:.2f}")
            rows.append((name, number, f"{error:.2f}", span))
        return rows

    @property
    def perhaps(self) -> dict[str, float]:
        """Highest value of each element that only other names have [at.%]."""
        others = {element: high for element, (_, high) in self.span.items() if element not in self.at_percent}
        return {element: high for element, high in others.items() if high > _LEAST_OF_OTHERS}

    def plain(self) -> dict[str, object]:
        """As in the JSON of ``apt-evap composition``."""
        shares = {e: {"at_percent": value, "error": self.error[e]} for e, value in self.at_percent.items()}
        more: dict[str, object] = {"refused": self.refused} if self.refused else {}
        if self.perhaps:
            more["perhaps"] = {e: {"highest": high, "error": self.error[e]} for e, high in self.perhaps.items()}
        if self.without_mass:
            more["ions_without_mass"] = self.without_mass
        return {"composition": shares, "unexplained": self.unexplained, **more}


@dataclass(frozen=True)
class Amounts:
    """Numbers of ions with their covariance.

    Parameters
    ----------
    atoms : sequence of mapping
        Atoms of each ion.
    ions : ndarray
        Number of ions, shape (n,).
    covariance : ndarray
        Of the numbers, shape (n, n).
    others : sequence
        Other explanations: atoms, numbers and covariance of their ions, and by how much chi-squared is above, with the
        part of the costs that counts in the error.
    """

    atoms: Sequence[Mapping[str, int]]
    ions: Floats
    covariance: Floats
    others: Sequence[tuple[Sequence[Mapping[str, int]], Floats, Floats, float]] = field(default=())

    def composition(self, unexplained: float, refused: str = "", without_mass: int = 0) -> Composition:
        """Composition of these ions; none where too much is unexplained."""
        if not refused and unexplained > MOST_UNEXPLAINED:
            refused = f"{unexplained:.1%} of the ions in peaks are unexplained, more than {MOST_UNEXPLAINED:.0%}"
        share, errors = _shares(self.atoms, self.ions, self.covariance)
        if not refused and not share:
            refused = "no ion has a name"
        if refused:
            return Composition({}, {}, {}, unexplained, refused, without_mass)
        span = {element: [value, value] for element, value in share.items()}
        weights, spread = dict.fromkeys(share, 1.0), dict.fromkeys(share, 0.0)
        for *other, worse in self.others:
            values, other_errors = _shares(*other)
            weight = math.exp(-max(worse, 0.0) / _LIKELY)
            weight *= weight > _LIKELIEST
            for element in {**span, **values} if values else ():
                value = values.get(element, 0.0)
                low, high = span.get(element, (0.0, 0.0))
                span[element] = [min(low, value), max(high, value)]
                if element not in share and value > high:
                    # where only the sum of two ions is known, the errors of both are larger than it
                    errors[element] = min(other_errors[element], value)
                change = abs(value - share.get(element, 0.0))
                # of an element that they do not change, others say nothing: they would make its error smaller
                if change > _NO_CHANGE * errors[element]:
                    weights[element] = weights.get(element, 1.0) + weight
                    spread[element] = spread.get(element, 0.0) + weight * change**2
        spreads = {element: math.sqrt(spread.get(element, 0.0) / weights.get(element, 1.0)) for element in span}
        errors = {element: math.hypot(errors[element], spreads[element]) for element in span}
        order = sorted(share, key=lambda element: -share[element])
        every = [*order, *sorted({*span} - {*order})]
        return Composition(
            {element: share[element] for element in order},
            {element: errors[element] for element in every},
            {element: (span[element][0], span[element][1]) for element in every},
            unexplained,
            without_mass=without_mass,
        )


def _shares(atoms, ions, covariance):
    """Composition and its standard errors [at.%]; none without ions."""
    numbers: dict[str, float] = {}
    for composition, number in zip(atoms, np.asarray(ions).tolist(), strict=True):
        for element, count in composition.items():
            numbers[element] = numbers.get(element, 0.0) + count * number
    numbers = {element: number for element, number in numbers.items() if number > 0}
    total = sum(numbers.values())
    if not total > 0:
        return {}, {}
    share = {element: 100 * number / total for element, number in numbers.items()}
    # derivatives of the shares by the numbers of ions
    count = np.array([[composition.get(element, 0) for composition in atoms] for element in share], float)
    slope = (100 * count - np.array(list(share.values()))[:, None] * count.sum(0)) / total
    error = np.sqrt(np.maximum(np.einsum("ei,ij,ej->e", slope, covariance, slope), 0))
    return share, dict(zip(share, error.tolist(), strict=True))
