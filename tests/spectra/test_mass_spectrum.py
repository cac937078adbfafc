"""Mass spectra: known ions, background, time zero and flight length are found; noise and wrong elements are not."""

import re
from dataclasses import replace
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
import pytest

import apt_evap as ae
from apt_evap.detection.timing import MASS_TO_CHARGE
from apt_evap.io.formats import read_ranges
from apt_evap.spectra.ion_names import Abundances, ion_name
from apt_evap.spectra.isotope_comb import STEP, LogSpectrum
from apt_evap.warnings import DataWarning

DATA = Path(__file__).parents[3] / "shared" / "data"
NICKEL = {("Ni", 2): 5, ("Ni", 1): 3}
STEEL = {("Fe", 2): 8, ("Cr", 2): 1, ("Al", 2): 0.5}


def masses_of(ions, n, rng):
    """m/n of n ions in given proportions [Da], shape (n,)."""
    shares = np.array(list(ions.values()), float)
    which, masses = rng.choice(len(ions), n, p=shares / shares.sum()), np.zeros(n)
    for number, (formula, charge) in enumerate(ions):
        isotopes, abundances = Abundances().lines(formula)
        rows = which == number
        masses[rows] = rng.choice(isotopes, np.count_nonzero(rows), p=abundances) / charge
    return masses


def recorded(ions, distance, time_zero, voltages=(4000, 4400), n=20_000, background=4000, seed=1):
    """Hits of an instrument, with noise of 0.3 ns, and ions at any time."""
    rng = np.random.default_rng(seed)
    total = n + background
    voltage = np.linspace(*voltages, total)
    radius, angle = 35 * np.sqrt(rng.random(total)), 2 * np.pi * rng.random(total)
    x, y = radius * np.cos(angle), radius * np.sin(angle)
    time = rng.uniform(0, 1500, total)
    rows = rng.permutation(total)[:n]
    path = distance**2 + radius[rows] ** 2
    time[rows] = np.sqrt(masses_of(ions, n, rng) * path / (MASS_TO_CHARGE * voltage[rows])) + time_zero
    time[rows] += 0.3 * rng.standard_normal(n)
    return ae.Hits(x=x, y=y, time_of_flight=time, voltage=voltage)


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize(
    ("ions", "distance", "time_zero", "voltages"),
    [
        (NICKEL, 90.0, 20.0, (4000, 4400)),
        (NICKEL, 95.0, 0.0, (4000, 7000)),
        (NICKEL, 90.0, 20.0, (4000, 7000)),  # without the time zero, the voltages smear the peaks
        ({("Al", 1): 5, ("Al", 2): 1}, 92.0, 5.0, (5000, 5200)),
        ({("Cu", 1): 4, ("Cu", 2): 1}, 100.0, -12.0, (5000, 8000)),
    ],
)
def test_flight_length_and_time_zero_are_found_within_three_errors(ions, distance, time_zero, voltages, seed):
    hits = recorded(ions, distance, time_zero, voltages, seed=seed)
    element = next(iter(ions))[0]
    result = ae.spectrum(hits, element, distance=1.01 * distance)
    fit = result.flight
    assert abs(fit.distance - distance) < 3 * fit.distance_error < 0.01 * distance
    assert abs(fit.time_zero - time_zero) < 3 * fit.time_zero_error < 5.0
    assert {ion.name for ion in result.ions} == {ion_name(*ion) for ion in ions}


@pytest.mark.slow
@pytest.mark.parametrize("time_zero", [0.0, 5.0])
@pytest.mark.parametrize("voltages", [(5000, 5001), (4000, 6000)])
@pytest.mark.parametrize("aluminium", [{("Al", 1): 3}, {("Al", 2): 3}, {("Al", 2): 2, ("Al", 1): 1}])
def test_peaks_of_other_ions_are_not_taken_for_those_of_the_element(aluminium, voltages, time_zero):
    """Si2+ and N2+ are 4 % beside Al2+ and Al+, with twice as many ions."""
    ions = aluminium | {("Si", 2): 4, ("N2", 1): 3}
    result = ae.spectrum(recorded(ions, 90.0, time_zero, voltages), "Al", distance=90.9)
    assert abs(result.flight.distance - 90.0) < 0.3 and abs(result.flight.time_zero - time_zero) < 1.5
    assert {ion.name for ion in result.ions} == {ion_name(*ion) for ion in aluminium}


def test_one_charge_state_gives_a_factor_only():
    hits = recorded({("W", 3): 1}, 310.0, 30.0, (9000, 9100))
    fit = ae.spectrum(hits, "W", distance=305.0).flight
    assert fit.time_zero == 0 and np.isinf(fit.time_zero_error) and fit.peaks == ("W³⁺",)
    assert "cannot separate" in str(fit) and "check that length, the time zero, the voltages" in str(fit)
    # the factor puts the peak in its place: the length is that of the whole time of flight
    masses = fit.masses(hits)
    inside = (masses > 60) & (masses < 62.3)
    assert np.count_nonzero(inside) > 19_900
    assert abs(masses[inside].mean() / 61.28 - 1) < 2e-3


@pytest.mark.slow
def test_a_given_length_far_from_the_fitted_one_is_said():
    """Both numbers, and the voltages with which the given one would be right."""
    hits = recorded(NICKEL, 93.0, 20.0, (4000, 7000))
    fit = ae.spectrum(hits, "Ni", distance=90.0).flight
    errors = (fit.distance - 90.0) / fit.distance_error
    assert errors > 3
    told = f"this is {fit.distance - 90.0:.2f} mm, {errors:.0f} of its errors, above the 90 mm that were given"
    assert told in str(fit) and f"{fit.distance:.2f} ± " in str(fit) and "time zero" not in str(fit)
    (less,) = re.findall(r"voltages \(about (\d+)% less would do the same\)", str(fit))
    changed = replace(hits, voltage=hits.voltage * (1 - float(less) / 100))
    again = ae.spectrum(changed, "Ni", distance=90.0).flight
    # hits off the axis have longer paths, and the percentage is rounded
    assert again.distance == pytest.approx(90.0, abs=0.5)


def test_ions_and_background_of_peaks_are_counted():
    rng = np.random.default_rng(2)
    n, below = 30_000, 60_000
    mass = np.concatenate([masses_of(STEEL, n, rng) * rng.normal(1, 5e-4, n), rng.uniform(1, 100, below)])
    result = ae.spectrum(ae.Hits(mass_to_charge=mass))
    assert [ion.name for ion in result.ions] == ["Fe²⁺", "Cr²⁺", "Al²⁺"]
    for ion, share in zip(result.ions, (8, 1, 0.5), strict=True):
        assert abs(ion.ions - n * share / 9.5) < 3 * ion.error < 0.1 * ion.ions
    edges = np.arange(40.0, 50.0)
    assert np.allclose(result.background(edges), below / 99, rtol=0.05)
    labels = result.ranges().labels(ae.Hits(mass_to_charge=mass[:n]))
    assert np.mean(labels == "Fe") == pytest.approx(8 / 9.5, rel=0.03)


@pytest.mark.parametrize("seed", [0, *(pytest.param(seed, marks=pytest.mark.slow) for seed in (1, 2))])
@pytest.mark.parametrize("element", [None, "W", pytest.param("Cu", marks=pytest.mark.slow)])
def test_noise_has_no_ions(element, seed):
    hits = recorded(NICKEL, 90.0, 0.0, n=0, background=30_000, seed=seed)
    result = ae.spectrum(hits, element, distance=90.0)
    assert result.ions == () and not result.flight.peaks
    with pytest.raises(ValueError, match=r"^ranges need peaks"):
        result.ranges()
    with pytest.raises(ValueError, match="no peaks"):
        result.select("W")


@pytest.mark.parametrize(
    "element",
    ["Pt", *(pytest.param(name, marks=pytest.mark.slow) for name in ("Cu", "Co", "Fe", "Al", "Rh", "Ta", "Re"))],
)
def test_a_wrong_element_is_refused_in_a_sentence(element):
    hits = recorded({("W", 3): 1}, 310.0, 0.0, (9000, 9100))
    result = ae.spectrum(hits, element, distance=305.0)
    assert result.ions == ()
    with pytest.raises(ValueError, match=f"^no peaks of {element}: ") as error:
        result.select(element)
    assert "\n" not in str(error.value)


def test_few_ions_make_no_map():
    rng = np.random.default_rng(3)
    result = ae.spectrum(ae.Hits(mass_to_charge=masses_of(NICKEL, 2000, rng) * rng.normal(1, 5e-4, 2000)), "Ni")
    assert result.ions
    with pytest.raises(ValueError, match=r"^only (2,000|1,9..) ions"):
        result.select("Ni")


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(4))
def test_a_peak_beside_those_of_the_element_is_another_ion(seed):
    """One isotope fits any single peak within the tolerance of a nominal length: N2+ is not a second Al+."""
    hits = recorded({("Al", 1): 3, ("N2", 1): 2}, 90.0, 5.0, (4000, 7000), seed=seed)
    fit = ae.spectrum(hits, "Al", distance=91.0).flight
    assert fit.peaks.count("Al⁺") == 1
    assert fit.distance == pytest.approx(90.0, abs=0.2) and fit.time_zero == pytest.approx(5.0, abs=1.0)


def test_few_ions_are_the_reason_of_a_refusal():
    rng = np.random.default_rng(3)
    for number in (60, 5):
        masses = np.append(masses_of(NICKEL, 200_000, rng), np.full(number, 196.967))
        result = ae.spectrum(ae.Hits(mass_to_charge=masses * rng.normal(1, 5e-4, len(masses))), ["Ni", "Au"])
        if number == 5:
            assert result.refused.startswith("no peaks of Au: ")
        else:
            gold = result.ions[-1]
            assert gold.name == "Au⁺" and abs(gold.ions - 60) < 3 * gold.error < 40


def test_isotopes_of_a_molecule():
    lines = Abundances().lines
    masses, abundances = lines("O2")
    assert masses[0] == pytest.approx(31.990, abs=1e-3)
    assert abundances[0] == pytest.approx(0.99757**2, abs=1e-3)
    chromium, shares = lines("CrO")
    assert chromium[np.argmax(shares)] == pytest.approx(51.9405 + 15.9949, abs=1e-3)
    assert abundances.sum() == pytest.approx(1) and shares.sum() == pytest.approx(1)


@pytest.mark.parametrize("elements", ["w", "Xx", "", "W3+", "W W", ["W", 3], ["Ni", "N0"], "W" * 50])
def test_unknown_ions_are_refused(elements):
    with pytest.raises(ValueError, match=r"^elements must be"):
        ae.spectrum(ae.Hits(mass_to_charge=[58.0, 60.0]), elements)


def test_what_a_spectrum_needs_is_named():
    with pytest.raises(ValueError, match="mass_to_charge, or times of flight with time_of_flight, voltage"):
        ae.spectrum(ae.Hits(x=[0.0], y=[0.0]), distance=90.0)
    hits = recorded(NICKEL, 90.0, 0.0, n=100, background=0)
    with pytest.raises(ValueError, match="with distance"):
        ae.spectrum(hits)
    with pytest.raises(ValueError, match="distance must be"):
        ae.spectrum(hits, distance=-1.0)


@pytest.mark.parametrize("heavy", [1e30, np.inf, 500.0])
def test_masses_above_the_spectrum_are_left_out_and_said(heavy):
    with pytest.warns(DataWarning, match="1 of 2 ions are above 500 Da: these are left out"):
        assert ae.spectrum(ae.Hits(mass_to_charge=[heavy, 5.0])).ions == ()


def test_masses_below_zero_are_left_out_and_said():
    with pytest.warns(DataWarning, match=r"^mass_to_charge must be > 0 \[Da\], got 1 of 3 ions down to -3"):
        ae.spectrum(ae.Hits(mass_to_charge=[-3.0, 5.0, 6.0]))


@pytest.mark.parametrize("mass", [[], [np.nan, 0.0, 0.1], [5.0, 7.0]])
def test_strange_masses_have_no_peaks(mass):
    assert ae.spectrum(ae.Hits(mass_to_charge=np.array(mass))).ions == ()


def test_a_slow_comb_gives_the_same():
    """The best factor by a loop over factors, with the masses themselves and not their logarithms in bins."""
    rng = np.random.default_rng(5)
    mass = masses_of({("Cu", 1): 1}, 8000, rng) * rng.normal(1.031, 7e-4, 8000)
    comb = LogSpectrum(mass).comb("Cu", 1, 0.95, 1.08)
    isotopes, _ = Abundances().lines("Cu")
    factors = np.arange(0.95, 1.08, 1e-4)
    near = [np.sum(np.abs(mass[:, None] / (f * isotopes) - 1).min(axis=1) < 1e-3) for f in factors]
    assert abs(comb.factor - factors[np.argmax(near)]) < 3 * STEP
    assert comb.fill > 0.9


def test_combs_are_kept_where_no_ions_were_removed():
    """Of a spectrum without some peaks, those that were found before are what a search in that spectrum finds."""
    rng = np.random.default_rng(7)
    ions = {("Fe", 2): 8, ("Cr", 2): 2, ("Ni", 2): 2, ("Cu", 1): 2, ("Mo", 3): 2, ("C", 1): 1}
    mass = masses_of(ions, 30_000, rng) * rng.normal(1.01, 7e-4, 30_000)
    tried = [(formula, charge, 0.99, 1.03) for formula, charge in [*ions, ("Al", 1), ("Ti", 2), ("Zn", 1), ("W", 3)]]
    searched, fresh = LogSpectrum(mass), LogSpectrum(mass)
    before = [searched.comb(*ion) for ion in tried]
    for number in (0, 3):
        searched, fresh = (counts.without(before[number].intervals) for counts in (searched, fresh))
        after = [searched.comb(*ion) for ion in tried]
        fresh._combs.clear()
        assert after == [fresh.comb(*ion) for ion in tried]
        fresh._combs.clear()
        assert after[number] is None
    assert sum(one is other for one, other in zip(before, after, strict=True) if one) >= 2  # far from iron and copper


def test_saved_ranges_are_read_again(tmp_path):
    rng = np.random.default_rng(6)
    ions = {("Cr", 2): 3, ("CrO", 1): 1}
    hits = ae.Hits(mass_to_charge=masses_of(ions, 20_000, rng) * rng.normal(1, 5e-4, 20_000))
    ranges = ae.spectrum(hits, ["Cr", "CrO"]).ranges()
    ae.io.write_rrng(tmp_path / "a.rrng", ranges)
    again = read_ranges(tmp_path / "a.rrng")
    assert sorted(again.names) == sorted(ranges.names) and set(again.names) == {"Cr", "CrO"}
    assert np.abs(np.sort(again.low) - np.sort(ranges.low)).max() < 1e-4
    assert np.array_equal(again.labels(hits), ranges.labels(hits))
    with pytest.raises(ValueError, match="composition"):
        ae.io.write_rrng(tmp_path / "b.rrng", ae.spectra.Ranges(["?"], [1.0], [2.0]))
    assert not (tmp_path / "b.rrng").exists()


@pytest.mark.slow
def test_a_named_spectrum_is_drawn():
    result = ae.spectrum(recorded(NICKEL, 90.0, 10.0), "Ni", distance=90.0)
    ax = ae.plot.spectrum(result)
    assert {text.get_text() for text in ax.texts} == {"Ni$^{2{+}}$", "Ni$^{{+}}$"}
    assert "background" in [text.get_text() for text in ax.get_legend().get_texts()]
    plt.close(ax.figure)


@pytest.mark.slow
@pytest.mark.skipif(not (DATA / "W_tap.raw").exists(), reason="needs the measured tungsten, which is not distributed")
@pytest.mark.filterwarnings("ignore:.*1 of 100,000 ions lies far outside:apt_evap.warnings.DataWarning")
def test_measured_tungsten():
    hits = ae.read(DATA / "W_tap.raw")
    result = ae.spectrum(hits, "W", distance=305.0)
    assert [ion.name for ion in result.ions] == ["W³⁺", "W⁴⁺"]
    assert 64_000 < len(result.select("W")) < 67_000
    for element in ("Ni", "Re", "Ta", "Pt"):
        assert ae.spectrum(hits, element, distance=305.0).ions == ()
