import numpy as np
import pytest
from scipy import stats

from apt_evap._common.ion_random import IonRandom
from apt_evap.emission.post_ionisation import FLIGHT_CHARGES, RATIO_PARAMETERS
from apt_evap.specimen.isotopes import ISOTOPES, draw_isotopes, mean_mass
from apt_evap.specimen.materials import MATERIALS
from apt_evap.spectra.ion_names import HIGHEST_CHARGE

# standard atomic weights and their uncertainties (Prohaska et al., Pure Appl. Chem. 94, 573, 2022; abridged: Mg, Si,
# H, B, C, N, O)
ATOMIC_WEIGHTS = {
    "Mg": (24.305, 0.002),
    "Al": (26.9815384, 3e-7),
    "Si": (28.085, 0.001),
    "Ti": (47.867, 0.001),
    "Cr": (51.9961, 6e-4),
    "Fe": (55.845, 0.002),
    "Co": (58.933194, 3e-6),
    "Ni": (58.6934, 4e-4),
    "Cu": (63.546, 0.003),
    "Mo": (95.95, 0.01),
    "Rh": (102.90549, 2e-5),
    "Ag": (107.8682, 2e-4),
    "Ta": (180.94788, 2e-5),
    "W": (183.84, 0.01),
    "Ir": (192.217, 0.002),
    "Pt": (195.084, 0.009),
    "Au": (196.966570, 4e-6),
    "H": (1.0080, 2e-4),
    "B": (10.81, 0.02),
    "C": (12.011, 0.002),
    "N": (14.007, 0.001),
    "O": (15.999, 0.001),
    "V": (50.9415, 1e-4),
    "Mn": (54.938043, 2e-6),
    "Zr": (91.222, 0.003),
    "Nb": (92.90637, 1e-5),
    "Re": (186.207, 0.001),
}


def test_every_element_with_numbers_has_isotopes():
    assert set(HIGHEST_CHARGE) >= set(FLIGHT_CHARGES)
    assert set(ISOTOPES) >= set(HIGHEST_CHARGE) - {"D"} | set(MATERIALS) | set(RATIO_PARAMETERS) | set(ATOMIC_WEIGHTS)


# the commission states ranges: specimens of these elements differ by up to 1.5e-4
OF_RANGES = ("H", "Li", "B", "C", "N", "O", "Mg", "Si", "S", "Cl", "Ar", "Br", "Tl", "Pb")


@pytest.mark.parametrize("name", ISOTOPES)
def test_masses_and_abundances_are_those_of_nuclides(name):
    masses, abundances = np.array(ISOTOPES[name]).T
    assert abundances.sum() == pytest.approx(1, abs=1e-8)  # abundances have up to nine digits
    assert (abundances > 0).all() and (np.diff(masses) > 0.9).all()
    assert (abs(np.rint(masses) - masses) < 0.1).all()  # mass defects, from H to U


@pytest.mark.parametrize("name", ISOTOPES)
def test_the_mean_of_the_isotopes_is_the_standard_atomic_weight_of_ase(name):
    data = pytest.importorskip("ase.data")
    weight = data.atomic_masses[data.atomic_numbers[name]]
    # Yb was revised by 5e-5 after the table of ase (2016)
    assert mean_mass(name) == pytest.approx(weight, rel=1.6e-4 if name in OF_RANGES else 6e-5)


@pytest.mark.parametrize("name", ATOMIC_WEIGHTS)
def test_isotopes_give_the_standard_atomic_weight(name):
    weight, uncertainty = ATOMIC_WEIGHTS[name]
    assert mean_mass(name) == pytest.approx(weight, abs=uncertainty + 5e-5)  # masses rounded to 1e-4 Da


@pytest.mark.parametrize("name", MATERIALS)
def test_isotopes_agree_with_the_mass_of_the_material(name):
    # atomic weights have five digits, of some elements with an uncertainty of 1 or 2 in the last one
    uncertain = {"Zn": 4e-5, "Rh": 5e-5, "Pd": 5e-5, "Ru": 6e-5, "Pb": 9e-5}
    assert mean_mass(name) == pytest.approx(MATERIALS[name].mass, rel=uncertain.get(name, 3e-5))


@pytest.mark.parametrize("name", ISOTOPES)
def test_drawn_isotopes_have_the_natural_abundances(name):
    n = 100_000
    u = IonRandom(3, np.arange(n)).uniform()[:, 0]
    drawn = draw_isotopes((name,), np.zeros(n, int), [mean_mass(name)], u)
    masses, abundances = np.array(ISOTOPES[name]).T
    counts = np.array([np.count_nonzero(drawn == mass) for mass in masses])
    assert counts.sum() == n
    common = abundances * n > 5  # for the chi-squared distribution; the others join the most abundant
    host = np.argmax(abundances)
    for values in (counts, abundances):
        values[host] += values[~common].sum()
    if np.count_nonzero(common) > 1:
        assert stats.chisquare(counts[common], n * abundances[common]).pvalue > 1e-3  # fixed seed


def test_each_species_has_its_own_isotopes():
    species = np.array([0, 1, 2, 1, 0, 2])
    u = np.array([0.1, 0.1, 0.1, 0.95, 0.999, 0.5])
    drawn = draw_isotopes(("Ni", "Cu", "X"), species, [58.693, 63.546, 123.4], u)
    np.testing.assert_array_equal(drawn, [57.9353, 62.9296, 123.4, 64.9278, 63.9280, 123.4])


def test_random_numbers_at_the_ends_and_at_the_edges_give_an_isotope():
    ends = np.array([2.0**-53, 1 - 2.0**-53])
    for name, isotopes in ISOTOPES.items():
        drawn = draw_isotopes((name,), [0, 0], [mean_mass(name)], ends)
        np.testing.assert_array_equal(drawn, [isotopes[0][0], isotopes[-1][0]])
    drawn = draw_isotopes(("Cu",), [0, 0], [63.546], [np.nextafter(0.6915, 0), 0.6915])
    np.testing.assert_array_equal(drawn, [62.9296, 64.9278])


def test_a_mass_of_the_user_is_kept():
    u = np.full(2, 0.5)
    enriched = MATERIALS["Ni"].mass + 5.2
    np.testing.assert_array_equal(draw_isotopes(("Ni",), [0, 0], [enriched], u), [enriched] * 2)
    assert draw_isotopes(("Mg",), [0], [24.3], u[:1]) == [23.9850]  # a rounded atomic weight is natural


def test_no_ions_are_no_masses():
    assert draw_isotopes(("Ni",), [], [58.693], []).shape == (0,)
    assert draw_isotopes((), [], [], []).shape == (0,)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("Ni", [0], [58.7], [0.5]), "names must be a sequence"),
        ((["Ni"], [1], [58.7], [0.5]), "species must be from 0 to 0"),
        ((["Ni"], [-1], [58.7], [0.5]), "species must be from 0 to 0"),
        ((["Ni"], [0.5], [58.7], [0.5]), "species must contain integers"),
        ((["Ni"], [0], [58.7, 60.0], [0.5]), "masses must have shape"),
        ((["Ni"], [0], [0.0], [0.5]), "masses must be > 0"),
        ((["Ni"], [0], [58.7], [0.5, 0.5]), "u must have shape"),
        ((["Ni"], [0], [58.7], [1.0]), "u must be in"),
    ],
)
def test_bad_arguments_are_refused(arguments, message):
    with pytest.raises(ValueError, match=message):
        draw_isotopes(*arguments)
