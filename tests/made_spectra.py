"""Made mass spectra of known ions, for tests."""

import numpy as np

import apt_evap as ae
from apt_evap.spectra.ion_names import Abundances, atoms_of_formula


def made(ions, number=60_000, *, seed=1, background=0.05, width=4e-4, tail=1e-3, error=(1e-3, 1e-3), isotopes=None):
    """Hits of ions {(formula, charge): share}, with a tail to high masses and m/n that are 0.1 to 0.2 % too large."""
    rng = np.random.default_rng(seed)
    lines = Abundances(isotopes).lines
    masses, shares = [], []
    for (formula, charge), share in ions.items():
        m, a = lines(formula)
        masses.append(m / charge)
        shares.append(share * a)
    share = np.concatenate(shares)
    mass = rng.choice(np.concatenate(masses), number, p=share / share.sum())
    mass *= 1 + rng.exponential(tail, number) + rng.normal(0, width, number)
    below = (0.7 + 10 * rng.random(round(background * number))) ** 2
    mass = np.append(mass, below)
    mass *= 1 + error[0] + error[1] * np.exp(-mass / 30)
    rng.shuffle(mass)
    return ae.Hits(mass_to_charge=mass)


def truth(ions):
    """Composition of the ions [at.%]."""
    atoms = {}
    for (formula, _), share in ions.items():
        for element, number in atoms_of_formula(formula).items():
            atoms[element] = atoms.get(element, 0) + number * share
    total = sum(atoms.values())
    return {element: 100 * number / total for element, number in atoms.items()}


def distance(composition, expected):
    """Sum of the differences of two compositions [at.%]."""
    found = composition.at_percent
    return sum(abs(found.get(name, 0) - expected.get(name, 0)) for name in {*found, *expected})
