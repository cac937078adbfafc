"""Strays: ions far outside the field of view are found, left out and counted; a field of view of any shape is kept."""

import warnings
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import apt_evap as ae
from apt_evap.detection.hits import Hits, Outcome
from apt_evap.detection.strays import find_strays
from apt_evap.warnings import DataWarning

DATA = Path(__file__).parents[3] / "shared" / "data"


def disc(n, seed, radius=37.5):
    random = np.random.default_rng(seed)
    return radius * np.sqrt(random.random(n)) * np.exp(2j * np.pi * random.random(n))


def field_of_view(kind, n, seed):
    """Places [mm] of a field of view of some shape."""
    random = np.random.default_rng(seed)
    if kind == "ramp":  # the density falls to 2 % at one side
        places = disc(4 * n, seed)
        places = places[random.random(4 * n) < 0.02 + np.clip(0.5 + places.real / 75, 0, 1)]
    elif kind == "ring":  # a large dark pole in the middle
        places = disc(3 * n, seed)
        places = places[np.abs(places) > 20]
    elif kind == "parts":  # divided by a dark line
        places = disc(2 * n, seed)
        places = places[np.abs(places.real) > 2.5]
    elif kind == "strip":
        places = 75 * random.random(n) + 12j * random.random(n)
    elif kind == "rim":  # 10 mm wide, with 1 % of the ions
        rim = (37.5 + 10 * random.random(max(1, n // 100))) * np.exp(2j * np.pi * random.random(max(1, n // 100)))
        places = np.concatenate([disc(n, seed), rim])
    elif kind == "comb":  # quantised
        places = disc(n, seed)
        places = np.round(places.real / 0.3) * 0.3 + 1j * np.round(places.imag / 0.25) * 0.25
    else:
        places = disc(n, seed)
    return places[: n + n // 100]


SHAPES = ("disc", "ramp", "ring", "parts", "strip", "comb")


@pytest.mark.parametrize("kind", [*SHAPES, "rim"])
def test_no_ion_of_a_field_of_view_is_a_stray(kind):
    # the rim of 1 % needs an ion in each eighth of its circle
    for n in (16, 20, 30, 100, 1000, 20_000) if kind != "rim" else (5000, 20_000):
        for seed in range(20, 23):
            places = field_of_view(kind, n, seed)
            assert find_strays(places.real, places.imag) is None, (n, seed)


def add_strays(kind, x, y):
    """Rows of strays, whose coordinates are changed."""
    n, size = len(x), max(np.ptp(x), np.ptp(y))
    rows = {"two": [7, 11], "scales": [3, 4, 5, 6], "sentinel": range(0, n, 10), "line": range(0, n, 10)}
    rows = np.array(rows.get(kind, [7]) if kind != "half" else range(0, n, 2))
    if kind == "one":
        x[rows], y[rows] = 180, 15
    elif kind == "near":
        x[rows] = x.max() + 0.35 * size
    elif kind == "two":
        x[rows], y[rows] = [620, -30], [-40, 700]
    elif kind == "huge":
        x[rows] = 3e29
    elif kind == "scales":
        x[rows], y[rows] = [1e30, 1e10, 1e4, 700], [0, 1e20, -1e3, 50]
    elif kind in ("sentinel", "half"):
        x[rows] = y[rows] = -90 - size / 2
    else:  # one coordinate is missing
        x[rows] = -90 - size / 2
    return rows


@pytest.mark.parametrize("kind", ["one", "near", "two", "huge", "scales", "sentinel", "half", "line"])
@pytest.mark.parametrize("shape", SHAPES)
@pytest.mark.parametrize("dtype", ["f4", pytest.param("f8", marks=pytest.mark.slow)])
def test_strays_are_found(kind, shape, dtype):
    for n in (1200, 20_000):
        places = field_of_view(shape, n, 24)
        x, y = places.real.astype(dtype), places.imag.astype(dtype)
        rows = add_strays(kind, x, y)
        assert np.flatnonzero(find_strays(x, y)).tolist() == rows.tolist()


@pytest.mark.parametrize(("share", "stray"), [(0.03, True), (0.08, False)])
def test_a_part_apart_is_stray_below_a_twentieth_of_the_largest(share, stray):
    places = np.concatenate([disc(20_000, 26), 75 + disc(int(share * 20_000), 27, radius=10)])
    strays = find_strays(places.real, places.imag)
    assert (strays is not None and strays.tolist() == (np.arange(len(places)) >= 20_000).tolist()) == stray
    assert stray or strays is None


def test_strays_that_are_scattered_do_not_join_each_other():
    """2 % of the ions over 600 x 600 mm: those beside the field of view cannot be told from it."""
    places = disc(6000, 25)
    random = np.random.default_rng(25)
    places[:120] = random.uniform(-300, 300, 120) + 1j * random.uniform(-300, 300, 120)
    strays = find_strays(places.real, places.imag)
    assert not strays[120:].any() and strays[:120].mean() > 0.9
    assert np.abs(places[~strays]).max() < 37.5 * 1.3


def test_few_ions_have_no_strays():
    for x in ([1.0, 2.0], [0.0] * 14 + [1e6], [1.0] * 15):
        assert find_strays(np.array(x), np.zeros(len(x))) is None
    assert find_strays(np.full(100, 3.0), np.full(100, 4.0)) is None  # all at one place
    line = np.linspace(-30, 30, 100)
    assert find_strays(line, np.zeros(100)) is None
    assert np.flatnonzero(find_strays(np.append(line, 900.0), np.zeros(101))).tolist() == [100]


def measured(n=5000, seed=26, **columns):
    places = disc(n, seed)
    x, y = places.real, places.imag
    x[:3], y[:3] = [620.0, -30.0, 3e29], [-40.0, 700.0, 0.0]
    return Hits(x=x, y=y, source="a.epos", **columns)


def test_the_warning_counts_them_once():
    hits = measured()
    with pytest.warns(DataWarning) as caught:
        assert np.count_nonzero(hits.detected) == 4997
        for part in (hits, hits[:100], hits.within_circle(10.0), replace(hits, mass_to_charge=np.ones(5000))):
            assert part.map(bins=8).ions > 0 and "detected" in repr(part)
    assert len(caught) == 1
    assert str(caught[0].message).startswith("'a.epos': 3 of 5,000 ions lie far outside the field of view of 74.")
    with pytest.warns(DataWarning, match=r"1 of 4,998 ions lies .* at \(3e\+29, 0\) mm: it is left out"):
        replace(hits[2:], x=hits.x[2:].copy()).map()


@pytest.mark.filterwarnings("ignore::apt_evap.warnings.DataWarning")
def test_a_map_is_that_of_the_file_without_strays():
    hits = measured()
    clean = Hits(x=hits.x[3:], y=hits.y[3:])
    first, second = hits.map(), clean.map()
    np.testing.assert_array_equal(first.counts, second.counts)
    np.testing.assert_array_equal(first.mask, second.mask)
    assert first.extent == second.extent and first.ions == second.ions
    # a selection keeps the field of view of all ions
    assert np.count_nonzero(hits[:20].detected) == 17
    np.testing.assert_array_equal(hits[::2].detected, hits.detected[::2])
    np.testing.assert_array_equal(hits[hits.x > 0].detected, hits.detected[hits.x > 0])


def test_a_reconstruction_is_that_of_the_file_without_strays():
    hits = measured(voltage=np.linspace(5000.0, 5500.0, 5000))
    settings = {"distance": 90.0, "radius": 40.0, "atomic_volume": 0.0118, "efficiency": 0.5, "compression": 1.5}
    with pytest.warns(DataWarning, match="3 of 5,000 ions lie"):
        first = ae.reconstruct(hits, **settings)
    second = ae.reconstruct(Hits(x=hits.x[3:], y=hits.y[3:], voltage=hits.voltage[3:]), **settings)
    np.testing.assert_array_equal(first.positions, second.positions)


def test_simulated_ions_and_those_on_a_stated_detector_have_none():
    hits = measured()
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert replace(hits, outcome=np.full(5000, Outcome.HIT)).detected.all()
        assert replace(hits, extent=(-1e30, 1e30, -1e3, 1e3)).detected.all()


@pytest.mark.skipif(not DATA.exists(), reason="the measured files are not there")
def test_measured_fields_of_view():
    hits = ae.read(DATA / "Si.epos", columns=("x", "y"))
    assert find_strays(hits.x, hits.y) is None
    hits = ae.read(DATA / "W_tap.raw")
    # one ion, 100 mm from the centre and 28 mm from any other one
    assert np.flatnonzero(find_strays(hits.x, hits.y)).tolist() == [int(np.argmin(hits.x + hits.y))]
