"""Charge state ratios are those that were drawn, and the fields from them those of the draw, within their errors."""

from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from scipy import stats

import apt_evap as ae
from apt_evap.emission.post_ionisation import PostIonisation, charge_state_ratio, field_of_ratio
from apt_evap.specimen.isotopes import ISOTOPES, mean_mass
from apt_evap.spectra.charge_states import (
    charge_history,
    charge_state_ratio_history,
    charge_state_ratio_map,
    field_of_counts,
    ion_charges,
    ratio_of_counts,
)

DATA = Path(__file__).parents[3] / "shared" / "data"
NICKEL = """[Ions]
Number=1
Ion1=Ni
[Ranges]
Number=3
Range1=28.9 32.2 Vol:0.01 Ni:1 Color:00CC00
Range2=57.8 59.5 Vol:0.01 Ni:1 Color:00CC00
Range3=59.5 64.5 Vol:0.01 Ni:1 Color:00CC00
"""
ALMOST_ALWAYS = 1e-3  # probability of a false alarm on either side


def ions_in(field, element, least, n, seed):
    """Ions on a disc of radius 30 mm with charges drawn in a field [V/nm] of x and y."""
    rng = np.random.default_rng(seed)
    radius, azimuth = 30.0 * np.sqrt(rng.random(n)), 2 * np.pi * rng.random(n)
    x, y = radius * np.cos(azimuth), radius * np.sin(azimuth)
    charges = PostIonisation().draw([element], np.zeros(n, int), [least], field(x, y), rng.random(n))
    return ae.Hits(x=x, y=y, mass_to_charge=mean_mass(element) / charges, extra={"charge_state": charges})


def assert_normal(pulls):
    """Deviations over their errors have the chi square of as many normal numbers."""
    pulls = pulls[np.isfinite(pulls)]
    assert len(pulls) > 50
    assert ALMOST_ALWAYS < stats.chi2.sf((pulls**2).sum(), len(pulls)) < 1 - ALMOST_ALWAYS
    assert ALMOST_ALWAYS < stats.norm.sf(abs(pulls.sum()) / np.sqrt(len(pulls)))


# ---- numbers of ions -----------------------------------------------------------------------------------------------


def test_error_of_the_field_where_both_charges_are_equally_frequent():
    """1 % with 44 ions for a slope of 30; the slopes of the fit are 28 to 34."""
    for element, charge in (("Ni", 1), ("Al", 1), ("W", 3), ("Pt", 2)):
        field, error = field_of_counts(element, charge, 22, 22)
        assert field == field_of_ratio(element, charge, 1.0)
        assert 0.85 < error / field * (30 * np.sqrt(45)) / 2 < 1.1


@pytest.mark.parametrize("ratio", [0.05, 1.0, 30.0])
def test_errors_are_those_of_the_logarithm_over_the_slope(ratio):
    lower = 1_000_000
    upper = round(ratio * lower)
    field, error = field_of_counts("Ni", 1, lower, upper)
    step = 1e-5
    near = charge_state_ratio("Ni", 1, field * np.array([1 - step, 1 + step]))
    slope = np.log(near[1] / near[0]) / (2 * step)
    assert ratio_of_counts(lower, upper)[1] == pytest.approx(np.sqrt(1 / lower + 1 / upper), rel=1e-5)
    # the second order of the step of the error: 0.005^2
    assert error == pytest.approx(field * np.sqrt(1 / lower + 1 / upper) / slope, rel=1e-4)


@pytest.mark.parametrize("probability", [0.2, 0.5, 0.8])
def test_few_ions_have_little_bias_and_honest_errors(probability):
    """Exact mean and variance over the binomial distribution of 30 ions."""
    n = 30
    upper = np.arange(n + 1)
    weights = stats.binom.pmf(upper, n, probability)
    ratio, error = ratio_of_counts(n - upper, upper)
    wanted = np.log(probability / (1 - probability))
    mean = weights @ np.log(ratio)
    variance = weights @ (np.log(ratio) - mean) ** 2
    assert abs(mean - wanted) < 0.02 * np.sqrt(variance)
    assert weights @ error**2 == pytest.approx(variance, rel=0.1)
    assert np.isfinite(ratio).all() and np.isfinite(error).all()


# ---- maps ----------------------------------------------------------------------------------------------------------


def test_ratio_of_a_uniform_field():
    hits = ions_in(lambda x, y: np.full(len(x), 24.6), "Ni", 1, 100_000, 1)
    result = charge_state_ratio_map(hits, "Ni", 1, bins=25)
    expected = charge_state_ratio("Ni", 1, 24.6)
    assert_normal(np.log(result.ratio / expected) / result.ratio_error)
    assert_normal((result.field - 24.6) / result.field_error)
    assert np.log(result.total / expected) == pytest.approx(0, abs=4 * np.sqrt(4 / result.ions))
    assert result.lower.dtype == result.upper.dtype == np.int64
    np.testing.assert_array_equal(result.counts.counts * result.counts.mask, result.lower + result.upper)


@pytest.mark.parametrize(("element", "charge", "middle"), [("Ni", 1, 24.5), ("W", 3, 58.0), ("Si", 1, 19.8)])
def test_a_smooth_field_is_recovered(element, charge, middle):
    def field(x, y):
        return middle * (1 + 0.02 * np.cos(x / 10) * np.cos(y / 15))

    hits = ions_in(field, element, charge, 200_000, 2)
    result = charge_state_ratio_map(hits, element, charge, bins=30, least=100)
    x, y = np.meshgrid(*result.counts.centres)
    # the field at the centre of a bin and its mean over the bin of 2 mm differ by 2e-4, an error by 5e-3
    assert_normal((result.field - field(x, y)) / result.field_error)
    spread = np.nanstd(field(x, y)[np.isfinite(result.field)])
    assert np.nanmean(result.field_error) < 0.8 * spread  # there is a field to see


def test_as_a_detector_map():
    hits = ions_in(lambda x, y: 24.5 + 0.01 * x, "Ni", 1, 20_000, 3)
    counts = charge_state_ratio_map(hits, "Ni", bins=20).counts.counts
    least = int(np.median(counts[counts > 0]))
    assert (counts == least).any()  # as many are enough
    result = charge_state_ratio_map(hits, "Ni", bins=20, least=least)
    for quantity, values in (("ratio", result.ratio), ("field", result.field)):
        map = result.to_map(quantity)
        assert not map.is_counts and map.ions == result.counts.ions
        np.testing.assert_array_equal(map.mask, np.isfinite(values))
        np.testing.assert_array_equal(map.values[map.mask], values[map.mask])
        assert map.extent == result.counts.extent
    assert np.array_equal(np.isnan(result.ratio), result.lower + result.upper < least)
    with pytest.raises(ValueError, match="quantity"):
        result.to_map("fields")


def test_bins_of_another_map():
    hits = ions_in(lambda x, y: np.full(len(x), 24.5), "Ni", 1, 20_000, 4)
    few = charge_state_ratio_map(hits[:5000], "Ni", 1)
    assert max(few.lower.shape) == 10  # 50 ions per bin
    for like in (few, few.counts):
        more = charge_state_ratio_map(hits, "Ni", 1, like=like)
        np.testing.assert_array_equal(more.counts.x_edges, few.counts.x_edges)
        assert (more.lower >= few.lower).all() and more.ions > few.ions


def test_ions_that_missed_do_not_count():
    hits = ions_in(lambda x, y: np.full(len(x), 24.5), "Ni", 1, 4000, 5)
    missed = replace(hits, outcome=np.arange(4000) % 2)
    both = charge_state_ratio_map(hits[::2], "Ni", 1, bins=5), charge_state_ratio_map(missed, "Ni", 1, bins=5)
    np.testing.assert_array_equal(both[0].lower, both[1].lower)
    history = charge_state_ratio_history(missed, "Ni", 1, sections=4)
    assert history.ions == 2000 and history.middles.tolist() == [500, 1500, 2500, 3500]


def test_the_pair_with_most_ions_of_the_rarer_charge():
    charges = np.repeat([1, 2, 3, 4], [900, 300, 5000, 800])
    assert charge_history(charges, "W").charge == 3
    assert charge_history(charges, "W", 1).charge == 1


# ---- history -------------------------------------------------------------------------------------------------------


def test_course_of_a_rising_field():
    n = 40_000
    field = np.linspace(24.0, 25.0, n)
    rng = np.random.default_rng(6)
    charges = PostIonisation().draw(["Ni"], np.zeros(n, int), [1], field, rng.random(n))
    result = charge_history(charges, "Ni")
    assert len(result.middles) == n // 100
    assert_normal((result.field - np.interp(result.middles, np.arange(n), field)) / result.field_error)
    assert result.lower.sum() == np.count_nonzero(charges == 1) and result.ions == n
    sections = charge_history(charges, "Ni", sections=7)
    edges = np.linspace(0, n, 8).astype(int)
    ones = [np.count_nonzero(charges[low:high] == 1) for low, high in pairwise(edges)]
    assert sections.lower.tolist() == ones
    assert np.isnan(charge_history(charges[:150], "Ni", sections=10).ratio).all()


# ---- a run, and its files ------------------------------------------------------------------------------------------


@pytest.fixture(scope="session")
def real(small_tip, made_once):
    run = made_once(small_tip, 600, responses=False, seed=3)
    # a scale at which both charges are frequent
    return run.at_evaporation_field(flight_charges=PostIonisation(0.7))


def test_map_of_a_run(real):
    hits = real.hits(ae.Unperturbed())
    result = charge_state_ratio_map(hits, "Ni", bins=4, least=5)
    detected = hits.detected
    assert result.charge == 1 and result.counts.extent == hits.extent
    for charge, counts in ((1, result.lower), (2, result.upper)):
        assert 50 < counts.sum() == np.count_nonzero(detected & (real.flight_charges == charge))
    text = f"<ChargeStateMap: Ni2+/Ni1+ = {result.total:.3g}, {result.ions} ions, "
    assert repr(result).startswith(text) and " of 4 x 4 bins with at least 5>" in repr(result)


@pytest.mark.filterwarnings("ignore::apt_evap.warnings.DataWarning")
def test_ranges_of_a_file_give_the_map_of_the_run(real, tmp_path):
    """Written as .epos and .rrng, and read again: as measured ions, whose charges are known by their masses only."""
    hits = real.hits(ae.Unperturbed())
    own = charge_state_ratio_map(hits, "Ni", 1, bins=4, least=5)
    with pytest.warns(ae.warnings.DataWarning, match="can be taken for kV"):
        ae.write(tmp_path / "ni.epos", hits[hits.detected])
    (tmp_path / "ni.rrng").write_text(NICKEL)
    measured, ranges = ae.read(tmp_path / "ni.epos", voltage_unit="V"), ae.io.read_ranges(tmp_path / "ni.rrng")
    assert "charge_state" not in measured.extra
    by_ranges = charge_state_ratio_map(measured, "Ni", 1, ranges=ranges, like=own, least=5)
    np.testing.assert_array_equal(by_ranges.lower, own.lower)
    np.testing.assert_array_equal(by_ranges.upper, own.upper)
    np.testing.assert_array_equal(by_ranges.field, own.field)
    histories = [
        charge_state_ratio_history(ions, "Ni", 1, ranges=chosen, sections=3)
        for ions, chosen in ((hits[hits.detected], None), (measured, ranges))
    ]
    np.testing.assert_array_equal(histories[0].ratio, histories[1].ratio)


def test_a_spectrum_with_tails_gives_nearly_the_same_ratio(real):
    """Energy deficits shift ions out of their ranges, by the same fraction of the mass for both charges."""
    units = replace(real.units, timing=ae.detection.Timing(temperature=50.0))
    hits = replace(real, units=units).hits(ae.Unperturbed())
    ranges = ae.spectra.Ranges(["Ni", "Ni"], [28.9, 57.8], [32.2, 64.4])
    charges = ion_charges(hits, "Ni", ranges)
    assert set(charges) <= {0, 1, 2} and np.mean(charges[hits.detected] == 0) < 0.02
    inside = charges > 0
    assert np.array_equal(charges[inside], real.flight_charges[inside])


@pytest.mark.skipif(not DATA.exists(), reason="the measured Si.epos and Si.rrng are not there")
def test_charges_of_a_measured_file():
    ranges = ae.io.read_ranges(DATA / "Si.rrng")
    hits = ae.read(DATA / "Si.epos", columns=("mass_to_charge", "x", "y"))
    charges, mass = ion_charges(hits, "Si", ranges), hits.mass_to_charge
    assert np.array_equal(charges == 2, ((mass < 15.5) & (charges > 0)))
    assert np.count_nonzero(charges == 2) == np.isin(ranges.index(hits), [0, 4, 5]).sum()
    assert np.array_equal(ion_charges(hits, "Cr", ranges) == 2, np.isin(ranges.index(hits), [8, 9]))
    result = charge_state_ratio_map(hits, "Si", ranges=ranges)
    assert 12_000 < np.isfinite(result.ratio).sum() and 21 < np.nanmedian(result.field) < 22


# ---- ranges --------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("element", list(ISOTOPES))
def test_every_isotope_has_its_charge(element):
    electrons = list(ISOTOPES).index(element) + 1 if element in ("H", "He") else 4
    for mass, _ in ISOTOPES[element]:
        for charge in range(1, electrons + 1):
            ranges = ae.spectra.Ranges([element], [mass / charge - 0.1], [mass / charge + 0.3])
            assert ion_charges(ae.Hits(mass_to_charge=[mass / charge, 0.3]), element, ranges).tolist() == [charge, 0]


def test_only_single_atoms_have_charges():
    names = ["Ni", "Ni+", "Ni ++", "Ni2+", "NiO", "Ni2", "Ni"]
    low = [60.0, 57.9, 28.9, 30.0, 73.9, 115.8, 58.9]
    composition = [{}, {}, {}, {}, {}, {}, {"Ni": 1, "H": 1}]
    ranges = ae.spectra.Ranges(names, low, np.add(low, 0.2), composition=composition)
    charges = ion_charges(ae.Hits(mass_to_charge=np.add(low, 0.1)), "Ni", ranges)
    assert charges.tolist() == [1, 1, 2, 2, 0, 0, 0]


def test_a_dimer_is_not_an_atom():
    for name in ("Ni", "Ni2+"):
        with pytest.raises(ValueError, match=r"115\.8 to 116 Da is not a range of Ni, whose isotopes have 57\.9"):
            ion_charges(ae.Hits(mass_to_charge=[116.0]), "Ni", ae.spectra.Ranges([name], [115.8], [116.0]))


# ---- errors --------------------------------------------------------------------------------------------------------


def test_what_is_refused():
    hits = ions_in(lambda x, y: np.full(len(x), 24.5), "Ni", 1, 1000, 7)
    bare = replace(hits, extra={})
    ranges = ae.spectra.Ranges(["Ni"], [57.0], [60.0])
    for ions, element, options, message in (
        (bare, "Ni", {}, "these hits have no charges: pass ranges=read_ranges"),
        (bare, "Fe", {"ranges": ranges}, "ranges have no range of single atoms of Fe, only of Ni"),
        (bare, "Xx", {"ranges": ranges}, "element must be a chemical symbol such as 'Ni', got 'Xx'"),
        (hits, "Xx", {}, "element must be a chemical symbol such as 'Ni', got 'Xx'"),
        (hits, "ni", {}, "got 'ni'.*Ni"),
        (bare, "Ni", {"ranges": "ni.rrng"}, "ranges must be Ranges"),
        (bare, "Ni", {"ranges": ranges}, "two neighbouring charges, got charges 1"),
        (hits, 28, {}, "element must be a chemical symbol"),
        (hits, "Al", {}, r"the ions must be of Al, but 1,000 of 1,000 have another mass, such as 58\.7 Da"),
        (hits, "Ni", {"charge": 3}, "no ions of Ni with the charges 3 and 4"),
        (hits, "Ni", {"charge": 0}, "charge must be an integer from 1"),
        (hits, "Ni", {"least": 0}, "least must be an integer >= 1"),
        (hits, "Ni", {"bins": 0}, "bins must be an integer from 1"),
        (hits, "Ni", {"like": hits}, "like must be a map"),
        (
            hits,
            "Ni",
            {"bins": 100},
            "no bin contains 20 ions of Ni with the charges 1 and 2, at most [0-9]+: ",
        ),
        ("hits", "Ni", {}, "hits must be Hits"),
    ):
        with pytest.raises(ValueError, match=message):
            charge_state_ratio_map(ions, element, **options)
    for options, message in (({"sections": 0}, "sections must be"), ({"least": -1}, "least must be")):
        with pytest.raises(ValueError, match=message):
            charge_state_ratio_history(hits, "Ni", **options)


def test_an_element_without_a_fit_has_ratios_only():
    hits = ions_in(lambda x, y: np.full(len(x), 24.5), "Ni", 1, 1000, 8)
    result = charge_state_ratio_map(replace(hits, mass_to_charge=None), "Na", bins=3)
    assert np.isfinite(result.ratio).any()
    with pytest.raises(ValueError, match="element"):
        _ = result.field
