"""Short-range order: the Warren-Cowley parameter, and the apparent order by evaporation alone."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from apt_evap._common.types import Booleans, Estimated, Floats, Integers
from apt_evap._common.validation import (
    check_choice,
    check_count,
    check_kind,
    check_number,
    check_seed,
    check_sequence,
)
from apt_evap.detection.instrument import Instrument
from apt_evap.emission.perturbations import Perturbation
from apt_evap.measures.order import neighbour_pairs
from apt_evap.simulation.run import Run
from apt_evap.studies.visibility.recorded import names_of, recorded_ions

SHELL = 0.3
"""Radius within which ions are neighbours [nm]: between the first and the second neighbours of fcc metals."""

_RESAMPLES = 400  # of the bootstrap: 4 % of an error


@dataclass(frozen=True)
class FalseOrder:
    """Warren-Cowley parameters of a random alloy after its evaporation."""

    reconstructed: Estimated
    shuffled: Estimated
    true: Estimated
    ions: int
    solutes: int

    @property
    def unlike(self) -> Estimated:
        """The reconstructed parameter of unlike pairs, -alpha x / (1 - x), which is negative for ordering."""
        factor = self.solutes / (self.ions - self.solutes)
        return Estimated(-factor * self.reconstructed.value, factor * self.reconstructed.error)


def false_order(
    runs: Run | Sequence[Run],
    solute: str,
    instrument: Instrument | None = None,
    perturbation: Perturbation | None = None,
    *,
    shell: float = SHELL,
    permutations: int = 50,
    block: float = 1.0,
    seed: int = 0,
) -> FalseOrder:
    """Apparent order of a random alloy, by evaporation alone.

    Parameters
    ----------
    runs : Run or sequence of Run
        Runs of tips whose solutes are on random sites; counts of several runs are added.
    solute : str
        Name of the solute.
    instrument, perturbation
        As for `recorded_ions`.
    shell : float
        Largest distance of neighbours [nm].
    permutations : int
        Number of permutations of the labels.
    block : float
        Edge of the squares across the axis that the bootstrap draws [nm]: larger than the range of the correlations.
    seed : int
        Seed of permutations, bootstrap and instrument.

    Returns
    -------
    FalseOrder

    Examples
    --------
    >>> tip = ae.Tip("Ni", apex_radius=2.5, solutes={"Al": 0.2}, seed=1)
    >>> run = ae.Simulation(tip, seed=1).run(400, [ae.Unperturbed()], responses=False)
    >>> order = ae.studies.false_order(run, "Al")
    >>> order.ions, order.solutes
    (209, 63)
    """
    runs = [runs] if isinstance(runs, Run) else list(check_sequence(runs, "runs", "Run"))
    if not runs:
        raise ValueError("runs must contain at least one run, got none")
    check_number(shell, "shell", above=0, unit="nm")
    check_number(block, "block", above=0, unit="nm")
    random = np.random.default_rng(check_seed(seed))
    counts: list[list[Integers]] = [[], []]  # neighbours of solutes, and solutes among them, by block
    shuffled = np.zeros((check_count(permutations, "permutations", at_least=2), 2), dtype=np.int64)
    ions = solutes = 0
    for run in runs:
        names = names_of(check_kind(run, "runs", Run, "a sequence of Run").elements)[0]
        recorded = recorded_ions(run, instrument, perturbation, seed)
        chosen = recorded.labels == names.index(check_choice(solute, "solute", names))
        if not 0 < chosen.sum() < len(chosen):
            raise ValueError(f"solute must be among other ions, got {chosen.sum()} {solute} in {len(chosen)} ions")
        ions, solutes = ions + len(chosen), solutes + int(chosen.sum())
        cells = np.unique(np.floor(recorded.sites[:, :2] / block), axis=0, return_inverse=True)[1].ravel()
        pairs = _pairs(recorded.positions, shell)
        counts[0].append(_by_block(pairs, chosen, cells))
        counts[1].append(_by_block(_pairs(recorded.sites, shell), chosen, cells))
        for row in shuffled:
            row += _counts(pairs, random.permutation(chosen))
    fraction = solutes / ions
    by_chance = [_parameter(neighbours, like, fraction) for neighbours, like in shuffled]
    reconstructed, true = (_bootstrap(np.concatenate(parts), fraction, random) for parts in counts)
    return FalseOrder(
        reconstructed, Estimated(float(np.mean(by_chance)), float(np.std(by_chance, ddof=1))), true, ions, solutes
    )


def _pairs(positions: Floats, shell: float) -> Integers:
    """Rows of neighbours in both orders, shape (m, 2)."""
    pairs = neighbour_pairs(positions, shell)
    return np.concatenate([pairs, pairs[:, ::-1]])


def _counts(pairs: Integers, solutes: Booleans) -> tuple[int, int]:
    """Number of neighbours of solutes, and of solutes among them."""
    neighbours = pairs[solutes[pairs[:, 0]], 1]
    return len(neighbours), int(np.count_nonzero(solutes[neighbours]))


def _parameter(neighbours: Any, solutes: Any, fraction: float) -> float:
    return float(1 - solutes / neighbours / fraction) if neighbours else float("nan")


def _by_block(pairs, solutes, cells):
    """`_counts` of the solutes of each block, shape (b, 2)."""
    chosen = pairs[solutes[pairs[:, 0]]]
    n = cells.max() + 1
    every = np.bincount(cells[chosen[:, 0]], minlength=n)
    return np.column_stack([every, np.bincount(cells[chosen[:, 0]], solutes[chosen[:, 1]], n)]).astype(np.int64)


def _bootstrap(blocks, fraction, random):
    """Parameter of the sum over the blocks, and its standard deviation as blocks are drawn with replacement."""
    drawn = random.integers(len(blocks), size=(_RESAMPLES, len(blocks)))
    values = [_parameter(*row, fraction) for row in blocks[drawn].sum(axis=1)]
    return Estimated(_parameter(*blocks.sum(axis=0), fraction), float(np.nanstd(values, ddof=1)))
