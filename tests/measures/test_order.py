"""Radial distribution of crystals and random alloys, and the Warren-Cowley parameters of L1_2."""

import numpy as np
import pytest

import apt_evap as ae
from apt_evap.specimen.lattice import Lattice, lattice_sites_in

A = 0.352  # nm


@pytest.fixture(scope="session")
def cube():
    """Sites of an fcc cube of 8 cells, and their corner of the cell: the minority of L1_2."""
    sites, _ = lattice_sites_in(
        Lattice("fcc", A, None, np.eye(3), np.zeros(3)),
        lambda points: np.abs(points).max(axis=1) - 4 * A,
        [[-4 * A] * 3, [4 * A] * 3],
        tolerance=1e-6,
    )
    return sites, np.all(np.isclose(np.mod(sites / A + 0.01, 1), 0.01, atol=1e-3), axis=1)


def test_the_shells_of_fcc_have_their_coordination_numbers(cube):
    sites = cube[0]
    every = np.ones(len(sites), bool)
    result = ae.measures.radial_distribution(sites, every, every, reach=0.5, step=0.01)
    for distance, number in ((A / np.sqrt(2), 12), (A, 6), (A * np.sqrt(1.5), 24), (A * np.sqrt(2), 12)):
        near = np.abs((result.edges[1:] + result.edges[:-1]) / 2 - distance) < 0.015
        assert result.pairs[near].sum() == number * result.centres
    assert result.pairs.sum() == 54 * result.centres
    assert np.array_equal(result.g, result.random)
    # the hull of the sites is smaller than the volume of their cells: 8^3 cells
    volume = 4 / 3 * np.pi * np.diff(result.edges**3)
    assert (result.g * volume).sum() == pytest.approx(54 * (8 * A) ** 3 / len(sites), rel=1e-9)


def test_unlike_species_of_a_perfect_order_have_a_first_shell_only_of_each_other(cube):
    sites, corners = cube
    result = ae.measures.radial_distribution(sites, corners, corners, reach=0.4, step=0.05)
    assert result.pairs[result.edges[1:] < A].sum() == 0 and result.pairs.sum() == 6 * result.centres


def test_a_random_cloud_is_flat():
    rng = np.random.default_rng(1)
    positions, label = 12 * rng.random((30_000, 3)), rng.random(30_000) < 0.3
    result = ae.measures.radial_distribution(positions, label, ~label, reach=1.5, step=0.1)
    away = (result.g[3:] - 1) / result.errors[3:]
    # pairs of shared ions are not independent: up to 1.5 of a Poisson error, of which the largest of 12 is below 3
    assert np.abs(away).max() < 4.5 and np.abs(result.g[3:] - 1).max() < 0.03
    assert away.std() > 0.7  # not of errors that are too large: of 12 Poisson numbers 1 +- 0.2


def test_the_parameters_of_l1_2(cube):
    sites, corners = cube
    inner = np.abs(sites).max(axis=1) < 3 * A
    result = ae.measures.short_range_order(sites, corners.astype(int), 0.3)
    assert result.parameters[1, 1] == 1.0  # no minority beside a minority
    assert result.parameters[1, 0] == pytest.approx(1 - 1 / result.fractions[0])
    near = ae.measures.short_range_order(sites, np.where(inner, corners, 2).astype(int), (0.3, 0.4))
    assert near.pairs[1, 0] == 0  # the second shell of a minority: minorities only
    # 8 of the 12 neighbours of a majority are of the majority; at faces fewer
    assert result.neighbours[0, 1] == pytest.approx(1 / 3, abs=0.03)
    assert np.abs(result.random / result.random_deviations).max() < 3.5 / np.sqrt(20) + 1  # its mean is -1 / (n - 1)


def test_the_parameter_is_that_of_a_double_loop(cube):
    sites = cube[0][::3]
    solute = np.random.default_rng(1).random(len(sites)) < 0.2
    distances = np.linalg.norm(sites[:, None] - sites, axis=2)
    near = (distances <= 0.4) & (distances > 0)
    like = near[solute][:, solute].sum() / near[solute].sum()
    result = ae.measures.short_range_order(sites, solute.astype(int), 0.4)
    assert result.parameters[1, 1] == pytest.approx(1 - like / solute.mean(), abs=1e-12)
    assert np.array_equal(result.pairs, result.pairs.T) and result.pairs.sum() == near.sum()


def test_a_random_alloy_is_within_its_permutations(cube):
    sites = cube[0]
    away = []
    for seed in range(20):
        label = (np.random.default_rng(seed).random(len(sites)) < 0.1).astype(int)
        result = ae.measures.short_range_order(sites, label, 0.3, seed=seed)
        away.append((result.parameters[1, 1] - result.random[1, 1]) / result.random_deviations[1, 1])
    # of 20 permutations, the deviation of one has an error of 16 %; 20 values have a scatter of 1 +- 0.16
    assert np.std(away) == pytest.approx(1.0, abs=0.55) and abs(np.mean(away)) < 3.5 / np.sqrt(20)


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda s: ae.measures.short_range_order(s[:1], [0], 0.3), "at least two of known ions, got 1 of 1"),
        (lambda s: ae.measures.short_range_order(s[:2], [1, 1], 0.3), "at least two of known ions, got 1 of 2"),
        (lambda s: ae.measures.short_range_order(s[:2], [0, 1], 1e-3), "got none of 2 ions from 0 to 0.001 nm"),
        (
            lambda s: ae.measures.short_range_order(s, np.zeros(len(s), int), (0.3, 0.2)),
            "shell must be",
        ),
        (lambda s: ae.measures.radial_distribution(s, s[:, 0] > 9, s[:, 0] > 9, 0.5), "about must mark ions deeper"),
        (lambda s: ae.measures.radial_distribution(s, s[:, 0] > 0, s[:, 0] > 0, 9.0), "about must mark ions deeper"),
        (lambda s: ae.measures.radial_distribution(s[:2], [True] * 2, [True] * 2), "at least four ions"),
    ],
)
def test_wrong_arguments_are_named(cube, call, message):
    with pytest.raises(ValueError, match=message):
        call(cube[0])
