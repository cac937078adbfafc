"""Specimens of several phases: which atom is where."""

import json
import warnings

import numpy as np
import pytest
from scipy.spatial import cKDTree

import apt_evap as ae
from apt_evap.specimen.alloy import SOLUTE, VACANCY, site_numbers
from apt_evap.warnings import DataWarning

AL = ae.material("Al")
BALL = ae.specimen.Sphere((0, 0, 3), 2.0)
SHAPE = {"apex_radius": 5.0, "shank_length": 5.0}
D = AL.nearest_neighbour_distance


def tip_of(*phases, **more):
    return ae.Tip(phases=[ae.specimen.Phase("matrix", AL), *phases], **(SHAPE | more))


def sites(tip):
    """Atoms as a set: position, element and phase."""
    keys = zip(map(tuple, tip.positions.tolist()), tip.species.tolist(), tip.phase.tolist(), strict=True)
    return set(keys)


def fraction_error(n, fraction):
    """Four standard deviations of a fraction among n sites."""
    return 4 * np.sqrt(fraction * (1 - fraction) / n)


# ---- equal phases --------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("alloy", [{}, {"solutes": {"Cu": 0.1}}])
def test_equal_phases_are_one_phase(alloy):
    one = ae.Tip(AL, axis=(1, 1, 1), offset_seed=2, seed=5, **SHAPE, **alloy)
    two = ae.Tip(
        phases=[ae.specimen.Phase("matrix", AL, **alloy), ae.specimen.Phase("ball", AL, region=BALL, **alloy)],
        axis=(1, 1, 1),
        offset_seed=2,
        seed=5,
        **SHAPE,
    )
    np.testing.assert_array_equal(one.positions, two.positions)
    np.testing.assert_array_equal(one.species, two.species)
    assert [element.name for element in one.elements] == [element.name for element in two.elements]
    np.testing.assert_array_equal(two.phase == 1, BALL.distance(two.positions) <= 1e-7)
    assert one.phase_names == ("matrix",) and two.phase_names == ("matrix", "ball")


def test_the_last_phase_is_where_several_are():
    core = ae.specimen.Phase("core", AL, region=ae.specimen.Sphere((0, 0, 3), 1.0))
    shell = ae.specimen.Phase("shell", AL, region=BALL)
    tip = tip_of(shell, core)
    radius = np.linalg.norm(tip.positions - [0, 0, 3], axis=1)
    expected = np.where(radius <= 1, 2, np.where(radius <= 2, 1, 0))
    np.testing.assert_array_equal(tip.phase, expected)
    nested = tip_of(core, ae.specimen.Phase("shell", AL, region=ae.specimen.CoreShell(core.region, 1.0)))
    np.testing.assert_array_equal(np.array([0, 2, 1])[nested.phase], expected)


def test_a_function_of_points_is_a_region():
    tip = tip_of(ae.specimen.Phase("half", "Al", region=lambda points: points[:, 0] > 0.01))
    np.testing.assert_array_equal(tip.phase == 1, tip.positions[:, 0] > 0.01)
    json.dumps(tip.settings)
    with pytest.raises(ValueError, match="region"):
        ae.Tip.from_settings(tip.settings)


# ---- composition ---------------------------------------------------------------------------------------------------


def test_evaporation_fields_of_a_phase_replace_those_of_the_materials():
    tip = ae.Tip(
        phases=[
            ae.specimen.Phase("matrix", AL, solutes={"Cu": 0.1}),
            ae.specimen.Phase("ball", AL, region=BALL, solutes={"Cu": 0.3}, evaporation_field={"Al": 15.0}),
            ae.specimen.Phase(
                "layer", AL, region=ae.specimen.Layer(-3, -2), solutes={"Cu": 0.3}, evaporation_field=25.0
            ),
        ],
        seed=1,
        **SHAPE,
    )
    fields = tip.evaporation_fields[tip.species]
    names = np.array([element.name for element in tip.elements])[tip.species]
    for phase, expected in enumerate(({"Al": 19.0, "Cu": 30.0}, {"Al": 15.0, "Cu": 30.0}, {"Al": 25.0, "Cu": 25.0})):
        for name, value in expected.items():
            assert set(fields[(tip.phase == phase) & (names == name)]) == {value}


def test_numbers_of_the_sites_are_uniform_and_independent():
    cells = np.indices((40, 40, 40)).reshape(3, -1) - 20
    first, other = (site_numbers(3, 0, cells, 1, use) for use in (VACANCY, SOLUTE))
    n = len(first)
    assert 0 < first.min() and first.max() < 1
    counts = np.bincount((first * 100).astype(int), minlength=100)
    assert ((counts - n / 100) ** 2 / (n / 100)).sum() < 99 + 5 * np.sqrt(2 * 99)  # chi square, 5 standard deviations
    grid = first.reshape(40, 40, 40)
    pairs = [(first, other), (grid[1:], grid[:-1]), (grid[:, 1:], grid[:, :-1]), (grid[..., 1:], grid[..., :-1])]
    for one, two in [*pairs, (first, site_numbers(4, 0, cells, 1, VACANCY)), (first, site_numbers(3, 1, cells, 1, 0))]:
        assert abs(np.corrcoef(one.ravel(), two.ravel())[0, 1]) < 5 / np.sqrt(one.size)


@pytest.mark.slow
@pytest.mark.parametrize("depth", [None, 2.0])
def test_fractions_of_solutes_and_vacancies(depth):
    matrix = ae.specimen.Phase("matrix", AL, solutes={"Cu": 0.2, "Si": 0.05}, vacancies=0.1)
    whole = ae.Tip(AL, depth=depth, **SHAPE)
    tip = ae.Tip(phases=[matrix], seed=3, depth=depth, **SHAPE)
    assert len(tip) / len(whole) == pytest.approx(0.9, abs=fraction_error(len(whole), 0.1))
    for species, fraction in enumerate((0.75, 0.2, 0.05)):
        assert (tip.species == species).mean() == pytest.approx(fraction, abs=fraction_error(len(tip), fraction))
    assert {tuple(point) for point in tip.positions.tolist()} <= {tuple(point) for point in whole.positions.tolist()}


def test_segregation_about_the_boundary_of_a_phase():
    profile = ae.specimen.Segregation(0.02, 0.3, 0.6)
    ball = ae.specimen.Phase("ball", AL, region=ae.specimen.Sphere((0, 0, 2), 2.5), solutes={"Cu": profile})
    tip = ae.Tip(phases=[ae.specimen.Phase("matrix", AL, solutes={"Cu": profile}), ball], seed=4, **SHAPE)
    distance = np.linalg.norm(tip.positions - [0, 0, 2], axis=1) - 2.5
    bins = np.digitize(distance, np.arange(-2.5, 3.6, 0.25))
    for number in range(1, 24):
        chosen = bins == number
        expected = (0.02 + 0.28 * np.exp(-(distance[chosen] ** 2) / (2 * 0.6**2))).mean()
        assert (tip.species[chosen] == 1).mean() == pytest.approx(expected, abs=fraction_error(chosen.sum(), expected))
    assert len(tip.elements) == 2


def test_segregation_about_another_region():
    profile = ae.specimen.Segregation(0.0, 0.5, 0.4, region=ae.specimen.Layer(-1, 1))
    tip = ae.Tip(phases=[ae.specimen.Phase("matrix", AL, solutes={"Cu": profile})], seed=4, **SHAPE)
    copper = np.abs(np.abs(tip.positions[tip.species == 1, 2]) - 1)
    expected = profile.fractions(np.abs(np.abs(tip.positions[:, 2]) - 1)).sum()
    assert copper.max() < 5 * 0.4 and len(copper) == pytest.approx(expected, abs=4 * np.sqrt(expected))


# ---- ordered compounds ---------------------------------------------------------------------------------------------


def interior(tip):
    """Atoms all of whose nearest neighbours are in the tip."""
    return tip.signed_distance(tip.positions) < -1.5 * tip.nearest_neighbour_distance


@pytest.mark.slow
@pytest.mark.parametrize(
    ("prototype", "structure", "fraction", "like", "unlike"),
    [
        # unlike neighbours of an atom of the second element, and its like ones
        ("L1_2", "fcc", 1 / 4, 0, 12),
        ("L1_0", "fcc", 1 / 2, 4, 8),
        ("B2", "bcc", 1 / 2, 0, 8),
        ("D0_3", "bcc", 1 / 4, 0, 8),
    ],
)
def test_neighbours_in_ordered_compounds(prototype, structure, fraction, like, unlike):
    host = ae.material({"fcc": "Ni", "bcc": "Fe"}[structure])
    phase = ae.specimen.Phase("compound", host, order=ae.specimen.Superlattice(prototype, "Al"))
    tip = ae.Tip(phases=[phase], apex_radius=4.0, shank_length=4.0, axis=(1, 1, 1))
    inside = interior(tip)
    second = tip.species == 1
    # the surface cuts cells: their share is the ratio of surface atoms to all atoms, about 15 %, of random sign
    assert second[inside].mean() == pytest.approx(fraction, abs=0.01)
    tree = cKDTree(tip.positions)
    chosen = np.flatnonzero(inside & second)
    near = tree.query_ball_point(tip.positions[chosen], tip.bond_length)
    for atom, others in zip(chosen, near, strict=True):
        numbers = second[[other for other in others if other != atom]]
        assert (numbers.sum(), (~numbers).sum()) == (like, unlike)
    if prototype == "D0_3":  # no second neighbours of the second element, as in B2; the third ones are
        second_shell = tree.query_ball_point(tip.positions[chosen], 1.05 * host.a)
        assert all(second[others].sum() == 1 for others in second_shell)


def test_l1_2_has_alternate_planes_and_a_quarter_of_the_second_element():
    a = ae.material("Ni").a
    tip = ae.Tip(phases=[ae.specimen.Phase("gamma prime", "Ni", order=ae.specimen.Superlattice("L1_2", "Al"))], **SHAPE)
    planes = np.rint(tip.positions[:, 2] / (a / 2)).astype(int)
    pure = planes % 2 == 1
    assert not (tip.species[pure] == 1).any()  # pure (002) planes alternate with mixed ones
    for plane in range(-8, 8, 2):
        chosen = (planes == plane) & interior(tip)
        assert (tip.species[chosen] == 1).mean() == pytest.approx(0.5, abs=0.02)  # the rim of a disc of 600 atoms
    assert (tip.species[interior(tip)] == 1).mean() == pytest.approx(0.25, abs=0.005)  # one plane more or less of 60


def test_a_basis_of_a_users_own():
    quarter = {"Al": 0.75, "Ti": 0.25}
    own = ae.specimen.UnitCell((quarter, None, None, None))
    shared = ae.specimen.Superlattice("L1_2", quarter)
    tips = [
        ae.Tip(phases=[ae.specimen.Phase("gamma prime", "Ni", order=order)], seed=2, **SHAPE) for order in (own, shared)
    ]
    np.testing.assert_array_equal(tips[0].species, tips[1].species)
    counts = np.bincount(tips[0].species)
    n = counts[1] + counts[2]
    assert counts[2] / n == pytest.approx(0.25, abs=fraction_error(n, 0.25))
    doubled = ae.specimen.UnitCell(
        ("Al", None, None, "Al"), cells=(2, 1, 1)
    )  # layers of bcc cells along x: corner, then centre
    tip = ae.Tip(phases=[ae.specimen.Phase("own", "Fe", order=doubled)], **SHAPE)
    cell = np.floor(tip.positions[:, 0] / 0.287 + 1e-6).astype(int) % 2
    centre = np.rint(2 * tip.positions[:, 0] / 0.287).astype(int) % 2 == 1
    np.testing.assert_array_equal(tip.species == 1, cell == centre)


# ---- several lattices ----------------------------------------------------------------------------------------------


def bicrystal(**more):
    grains = [
        ae.specimen.Phase("first", AL, axis=(0, 0, 1)),
        ae.specimen.Phase(
            "second", AL, region=ae.specimen.HalfSpace((0.1, 0, 0), (1, 0, 0.2)), axis=(1, 1, 1), rotation=7.0
        ),
    ]
    return ae.Tip(phases=grains, **(SHAPE | more))


@pytest.mark.parametrize("depth", [None, 1.8])
def test_grains_do_not_overlap_and_leave_no_gap(depth):
    tip = bicrystal(depth=depth)
    assert cKDTree(tip.positions).query(tip.positions, k=2)[0][:, 1].min() >= 0.7 * D
    boundary = ae.specimen.HalfSpace((0.1, 0, 0), (1, 0, 0.2)).distance(tip.positions)
    np.testing.assert_array_equal(tip.phase == 1, boundary <= 1e-7)
    # each grain is a perfect crystal away from the boundary
    for phase in (0, 1):
        inside = (tip.phase == phase) & (np.abs(boundary) > 1.5 * D) & interior(tip) & ~tip.support
        counts = cKDTree(tip.positions).query_ball_point(tip.positions[inside], tip.bond_length, return_length=True)
        assert set(counts[counts < 13].tolist()) == set() or depth is not None
    # no gap: the densities of the two halves of a slab of 1 nm about the boundary, within one layer of atoms of 1 nm
    if depth is None:
        slab = (np.abs(boundary) < 0.5) & (np.linalg.norm(tip.positions, axis=1) < 4)
        volume = np.pi * 4**2 * 1.0
        assert 0.85 < slab.sum() / (volume * 4 / AL.a**3) < 1.0


def test_a_precipitate_on_its_own_lattice():
    tungsten = ae.specimen.Phase("tungsten", "W", region=BALL, axis=(0, 1, 1))
    tip = tip_of(tungsten)
    assert cKDTree(tip.positions).query(tip.positions, k=2)[0][:, 1].min() > 0.7 * 0.5 * (D + 0.2737) - 1e-3
    assert set(tip.species[tip.phase == 1].tolist()) == {1}
    volume = 4 / 3 * np.pi * 2**3
    assert (tip.phase == 1).sum() == pytest.approx(volume * 2 / 0.316**3, rel=0.03)  # sites on the surface of the ball
    assert tip.criteria[0] != tip.criteria[1]
    assert tip.neighbour_radius == max(criterion.neighbour_radius for criterion in tip.criteria)


# ---- depth and settings --------------------------------------------------------------------------------------------

SPECIMENS = {
    "alloy": lambda **more: ae.Tip(AL, solutes={"Cu": 0.2}, seed=3, **SHAPE, **more),
    "bicrystal": bicrystal,
    "everything": lambda **more: ae.Tip(
        phases=[
            ae.specimen.Phase("matrix", "Ni", solutes={"Al": ae.specimen.Segregation(0.05, 0.3, 0.5)}, vacancies=0.02),
            ae.specimen.Phase(
                "gamma prime",
                "Ni",
                BALL,
                order=ae.specimen.Superlattice("L1_2", {"Al": 0.7, "Ti": 0.3}),
                evaporation_field=33.0,
            ),
            ae.specimen.Phase("void", "Ni", ae.specimen.Sphere((2, 0, 0), 0.8), vacancies=1),
            ae.specimen.Phase("tungsten", "W", ae.specimen.Layer(-4, -2), axis=(0, 1, 1)),
        ],
        seed=3,
        offset_seed=1,
        **SHAPE,
        **more,
    ),
}


@pytest.mark.slow
@pytest.mark.parametrize("name", SPECIMENS)
def test_a_deeper_shell_is_the_same_alloy(name):
    make = SPECIMENS[name]
    shell = make(depth=1.8)
    deeper = shell.deepened(1.0)
    n = len(shell)
    np.testing.assert_array_equal(deeper.positions[:n], shell.positions)
    np.testing.assert_array_equal(deeper.species[:n], shell.species)
    np.testing.assert_array_equal(deeper.phase[:n], shell.phase)
    assert sites(deeper) == sites(make(depth=2.8))
    assert sites(deeper) < sites(make())


@pytest.mark.parametrize("name", SPECIMENS)
def test_a_tip_is_rebuilt_from_its_settings(name):
    tip = SPECIMENS[name](depth=1.8)
    again = ae.Tip.from_settings(json.loads(json.dumps(tip.settings)))
    np.testing.assert_array_equal(again.positions, tip.positions)
    np.testing.assert_array_equal(again.species, tip.species)
    np.testing.assert_array_equal(again.phase, tip.phase)
    assert again.settings == tip.settings and again.phases == tip.phases


def test_another_seed_is_another_alloy():
    one, other = (ae.Tip(AL, solutes={"Cu": 0.2}, seed=seed, **SHAPE) for seed in (1, 2))
    both = (one.species == 1) & (other.species == 1)
    assert both.mean() == pytest.approx(0.04, abs=fraction_error(len(one), 0.04))


# ---- refusals ------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: ae.specimen.Phase("", AL), "name must be text"),
        (lambda: ae.specimen.Phase("p", "Xx"), "no material is named 'Xx'"),
        (lambda: ae.specimen.Phase("p", AL, region=3), "region must be a region such as Sphere"),
        (lambda: ae.specimen.Phase("p", AL, axis=(0, 0, 0)), "axis must not be zero"),
        (lambda: ae.specimen.Phase("p", AL, order="L1_2"), "order must be a Superlattice"),
        (
            lambda: ae.specimen.Phase("p", AL, order=ae.specimen.Superlattice("B2", "Cu")),
            "order B2 needs the structure bcc, got fcc",
        ),
        (
            lambda: ae.specimen.Phase("p", AL, order=ae.specimen.UnitCell(("Cu",))),
            "order must have 4 sites for fcc, got 1",
        ),
        (lambda: ae.specimen.Phase("p", AL, vacancies=1.5), "vacancies must be"),
        (
            lambda: ae.specimen.Phase("p", AL, evaporation_field={"Cu": 30}),
            "element in evaporation_field must be one of Al",
        ),
        (lambda: ae.specimen.Phase("p", AL, evaporation_field=-1), "evaporation_field must be"),
        (
            lambda: ae.specimen.Phase("p", AL, solutes={"Cu": 0.5, "Si": ae.specimen.Segregation(0.1, 0.6, 1)}),
            "a sum <= 1, got 1.1",
        ),
        (lambda: ae.specimen.Superlattice("L1_3", "Al"), "prototype must be one of L1_2"),
        (lambda: ae.specimen.Superlattice("L1_2", {"Al": 0.5}), "fractions with a sum of 1, got 0.5"),
        (lambda: ae.specimen.UnitCell(("Al", None, None), cells=(2, 1, 1)), "a multiple of 2 cells"),
        (lambda: ae.specimen.Segregation(0.1, 1.5, 1), "peak must be"),
        (lambda: ae.specimen.Segregation(0.1, 0.5, 1, region=lambda points: points), "region"),
        (lambda: ae.Tip(**SHAPE), "material or phases must be given"),
        (
            lambda: ae.Tip(AL, phases=[ae.specimen.Phase("m", AL)], **SHAPE),
            "material or phases must be given, not both",
        ),
        (lambda: ae.Tip(phases=[], **SHAPE), "phases must be 1 to 127 phases, got 0"),
        (lambda: ae.Tip(phases=[AL], **SHAPE), "phases must be phases"),
        (lambda: ae.Tip(phases=[ae.specimen.Phase("m", AL, BALL)], **SHAPE), "the first of the phases is the matrix"),
        (lambda: tip_of(ae.specimen.Phase("p", AL)), "phase p must have a region"),
        (lambda: tip_of(ae.specimen.Phase("matrix", AL, BALL)), "different names, got matrix twice"),
        (lambda: tip_of(ae.specimen.Phase("p", AL, BALL, vacancies=0.5)), "seed .* must be an integer"),
        (lambda: tip_of(seed=1, solutes={"Cu": 0.1}), "solutes must be those of a phase"),
        (lambda: ae.Tip(AL, solutes={"Al": 0.1}, seed=1, **SHAPE), "solutes must differ from the material, got Al"),
    ],
)
def test_wrong_arguments_are_refused(make, message):
    with pytest.raises(ValueError, match=message):
        make()


@pytest.mark.parametrize(
    ("region", "vacancies", "later"),
    [
        (ae.specimen.Sphere((50, 0, 0), 1.0), 0.0, []),
        (ae.specimen.Sphere((50, 0, 0), 1.0), 1.0, []),
        (ae.specimen.Sphere((0, 0, 3), 1.0), 0.0, [ae.specimen.Phase("later", AL, region=BALL)]),
    ],
    ids=["outside", "void outside", "covered"],
)
def test_a_phase_without_atoms_causes_a_warning(region, vacancies, later):
    with pytest.warns(DataWarning, match="phase lost "):
        tip_of(ae.specimen.Phase("lost", AL, region=region, vacancies=vacancies), *later)


def test_a_void_in_the_specimen_and_a_thin_layer_cause_no_warning():
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        tip_of(
            ae.specimen.Phase("void", AL, region=BALL, vacancies=1.0),
            ae.specimen.Phase("copper", "Cu", region=ae.specimen.Layer(-0.2, 0.2)),
        )
