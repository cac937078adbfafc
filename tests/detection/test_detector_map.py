import warnings
from pathlib import Path

import numpy as np
import pytest
import scipy
from hypothesis import assume, example, given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from matplotlib.text import Text

from apt_evap import plot
from apt_evap.detection.binning import bin_edges, count, field_of_view, find_quantisation
from apt_evap.detection.color_limits import color_limits
from apt_evap.detection.detector import Detector
from apt_evap.detection.detector_map import DetectorMap, gaussian
from apt_evap.detection.hits import Hits
from apt_evap.io.formats import read
from apt_evap.plot.map_figures import describe

SILICON = Path(__file__).parents[3] / "shared" / "data" / "Si.epos"


def disc(n, radius=10.0, seed=0):
    random = np.random.default_rng(seed)
    r, angle = radius * np.sqrt(random.random(n)), 2 * np.pi * random.random(n)
    return r * np.cos(angle), r * np.sin(angle)


def combed(n, spacings=(0.02725, 0.02602), seed=0):
    """A uniform disc on a comb, in single precision as files hold it."""
    return [
        (0.013 + np.rint(values / q) * q).astype("f4") for values, q in zip(disc(n, seed=seed), spacings, strict=True)
    ]


def modulation(map):
    """Scatter of the column and row totals over that of Poisson, in a square inside a uniform disc."""
    ny, nx = map.counts.shape
    middle = map.counts[ny // 4 : 3 * ny // 4, nx // 4 : 3 * nx // 4]
    return [totals.std() / np.sqrt(totals.mean()) for totals in (middle.sum(0), middle.sum(1))]


@given(st.integers(0, 2**32), st.integers(1, 40), st.integers(1, 300))
def test_counts_are_those_of_numpy(seed, bins, n):
    x, y = np.random.default_rng(seed).normal(size=(2, n))
    x_edges, y_edges = bin_edges(x, y, bins, (-1.1, 0.9, -0.8, 1.3))
    expected = np.histogram2d(y, x, (y_edges, x_edges))[0]
    np.testing.assert_array_equal(count(x, y, x_edges, y_edges), expected)


def test_counts_add_up_over_chunks():
    x, y = disc(400_000)
    x_edges, y_edges = bin_edges(x, y, 300)
    counts = count(x, y, x_edges, y_edges)
    assert counts.sum() == len(x)
    np.testing.assert_array_equal(counts, np.histogram2d(y, x, (y_edges, x_edges))[0])


def test_rows_are_y_and_columns_are_x():
    map = Hits(x=[0.0, 8.0, 8.0], y=[0.0, 1.0, 1.0]).map(bins=8)
    assert map.counts.shape == (1, 8)
    assert map.counts[0].tolist() == [1, 0, 0, 0, 0, 0, 0, 2]


@pytest.mark.parametrize("single", [False, True])
@pytest.mark.parametrize("bins", [1, 37, 256])
def test_bins_are_square_and_hold_every_hit(single, bins):
    x, y = disc(20_000)
    y = y / 2
    hits = Hits(x=x.astype("f4"), y=y.astype("f4")) if single else Hits(x=x, y=y)
    map = hits.map(bins=bins)
    assert map.position_step is None and map.counts.sum() == 20_000
    assert map.counts.shape[1] == bins and map.bin_size[0] == pytest.approx(map.bin_size[1], rel=1e-9)


@pytest.mark.parametrize("spacing, origin", [(0.02725, -13.568), (0.1, 0.0), (0.001, 40.0), (3.0, 1.5)])
@pytest.mark.parametrize("dtype", ["f4", "f8"])
def test_comb_is_found(spacing, origin, dtype):
    number = np.random.default_rng(3).integers(0, 900, 20_000)
    comb = find_quantisation((origin + spacing * number).astype(dtype))
    # the tooth furthest away is then off by less than 2 % of a spacing
    assert comb.spacing == pytest.approx(spacing, rel=2e-5)
    assert (comb.origin - origin) / spacing % 1 == pytest.approx(0, abs=0.02) or (
        comb.origin - origin
    ) / spacing % 1 == pytest.approx(1, abs=0.02)


def test_irregular_comb_is_found():
    random = np.random.default_rng(4)
    teeth = 0.03 * (np.arange(800) + random.uniform(-0.08, 0.08, 800))
    assert find_quantisation(random.choice(teeth, 50_000)).spacing == pytest.approx(0.03, rel=1e-4)


@given(st.integers(0, 2**32), st.sampled_from(["f4", "f8"]), st.sampled_from([10, 1000, 150_000]), st.booleans())
def test_continuous_coordinates_have_no_comb(seed, dtype, n, repeated):
    random = np.random.default_rng(seed)
    values = random.normal(0, 10, n).astype(dtype)
    assert find_quantisation(random.choice(values, n) if repeated else values) is None


@pytest.mark.parametrize("bins", [60, 200, 256, 333])
def test_bins_respect_the_comb(bins):
    x, y = combed(400_000)
    hits = Hits(x=x, y=y)
    fitted, naive, dithered = (hits.map(bins=bins, **how) for how in ({}, {"position_step": None}, {"dither_seed": 5}))
    assert np.allclose(fitted.position_step, (0.02725, 0.02602), rtol=1e-5)
    multiples = np.array(fitted.bin_size) / fitted.position_step
    np.testing.assert_allclose(multiples, np.rint(multiples), atol=1e-6)
    # half quanta: every edge lies midway between two teeth
    phase = (fitted.x_edges - 0.013) / fitted.position_step[0] % 1
    np.testing.assert_allclose(phase, 0.5, atol=0.02)
    assert fitted.counts.sum() == 400_000
    # 1 for Poisson; it scatters by 12 % for 30 totals, so 4 standard deviations
    assert max(modulation(fitted)) < 1.5 and max(modulation(dithered)) < 1.5
    if bins >= 200:
        assert max(modulation(naive)) > 3


def test_quantum_can_be_given():
    x, y = combed(5000)
    map = Hits(x=x, y=y).map(bins=50, position_step=(0.02725, 0.02602))
    assert (map.x_edges[0] - 0.013) / 0.02725 % 1 == pytest.approx(0.5, abs=0.02)
    for wrong in ("automatic", (0.1, -1.0), 3.0):
        with pytest.raises(ValueError, match="position_step"):
            Hits(x=x, y=y).map(position_step=wrong)


def test_dither_is_keyed_by_its_seed_and_needs_a_comb():
    x, y = combed(50_000)
    first, same, other = (Hits(x=x, y=y).map(dither_seed=seed).counts for seed in (1, 1, 2))
    assert np.array_equal(first, same)
    assert first.shape != other.shape or not np.array_equal(first, other)
    x, y = disc(5000)
    with pytest.raises(ValueError, match="needs a quantisation step"):
        Hits(x=x, y=y).map(dither_seed=1)


def test_like_takes_edges_and_mask_and_warns_of_stripes():
    x, y = disc(50_000)
    smooth = Hits(x=x, y=y).map(bins=100)
    x, y = combed(50_000)
    hits = Hits(x=x, y=y)
    with pytest.warns(UserWarning, match="stripes"):
        map = hits.map(like=smooth)
    assert map.x_edges is smooth.x_edges and map.mask is not None
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        hits.map(like=smooth, dither_seed=1)
        hits[::2].map(like=hits.map(bins=100))


def test_field_of_view_is_the_disc():
    x, y = disc(200_000)
    map = Hits(x=x, y=y).map(bins=100)
    grid = np.hypot(*np.meshgrid(*map.centres))
    # bins within two of the rim may go either way
    away = np.abs(grid - 10) > 2 * map.bin_size[0]
    assert np.array_equal(map.mask[away], grid[away] < 10)


def test_dark_lines_do_not_divide_a_field_of_view(rng):
    """Without roll-up zone lines have no hits at all; the smaller part was cut off."""
    places = rng.uniform(-30, 30, (60_000, 2))
    places = places[np.hypot(*places.T) < 30]
    dark = (np.abs(places[:, 1] + 8) < 1.5) | (np.abs(places[:, 0] - 12) < 1.5)
    whole = Hits(x=places[:, 0], y=places[:, 1]).map(bins=128)
    divided = Hits(x=places[~dark, 0], y=places[~dark, 1]).map(like=whole)
    assert field_of_view(divided.counts).sum() == pytest.approx(whole.mask.sum(), rel=0.02)


def test_field_of_view_keeps_dark_poles_and_drops_stray_hits():
    x, y = disc(100_000)
    dark = np.hypot(x - 3, y) > 2
    map = Hits(x=np.append(x[dark], 13.0), y=np.append(y[dark], 0.0)).map(bins=175)
    grid_x, grid_y = np.meshgrid(*map.centres)
    assert map.mask[np.hypot(grid_x - 3, grid_y) < 1].all()
    assert not map.mask[grid_x > 11].any()


@pytest.mark.parametrize("x, y", [([1.0, 2.0], [1.0, 1.0]), ([0.0, 1.0, 5.0], [0.0, 2.0, 1.0])])
def test_few_hits_still_make_a_map(x, y):
    map = Hits(x=x, y=y).map(bins=16)
    assert map.counts.sum() == len(x) and map.mask.any() and field_of_view(map.counts).any()


@given(hnp.arrays(int, hnp.array_shapes(min_dims=2, max_dims=2, max_side=12), elements=st.sampled_from((0, 0, 1, 50))))
@example(np.eye(9, dtype=int))
@example(np.eye(2, 12, 3, dtype=int) + np.eye(2, 12, dtype=int))
def test_the_field_of_view_of_any_counts_is_convex(counts):
    """The bin in the middle between two others inside is inside, too."""
    assume(counts.any())
    with warnings.catch_warnings():
        warnings.simplefilter("error")  # scikit-image warns of bins on one line, and returns none of them
        inside = field_of_view(counts)
    assert inside.any()
    places = np.argwhere(inside)
    sums = (places[:, None] + places).reshape(-1, 2)
    assert inside[tuple(sums[(sums % 2 == 0).all(axis=1)].T // 2)].all()


def test_the_grid_of_a_detector_is_all_of_it():
    x, y = disc(5_000, radius=30.0)
    hits = Hits(x=x, y=y)
    grid = Detector(width=77.0).grid(90)
    assert grid.extent == (-38.5, 38.5, -38.5, 38.5) and grid.values.shape == (90, 90)
    assert grid.mask.all() and not grid.counts.any() and grid.ions == 0
    map = hits.map(like=grid)
    expected = hits.map(90, extent=grid.extent, mask=np.ones((90, 90), bool))
    for name in ("counts", "x_edges", "y_edges", "mask"):
        assert np.array_equal(getattr(map, name), getattr(expected, name))
    assert map.ions == 5_000 and np.array_equal(hits.map(like=grid).density, expected.density)
    with pytest.raises(ValueError, match="bins"):
        Detector().grid(0)


def test_density_has_mean_one_inside_and_is_nan_outside():
    x, y = disc(30_000)
    for map in (Hits(x=x, y=y).map(bins=64), Hits(x=x, y=y).map(bins=64).smoothed(0.5)):
        assert map.density[map.mask].mean() == pytest.approx(1)
        assert np.isnan(map.density[~map.mask]).all()
        assert map.ions > 29_000


def test_smoothing_keeps_a_uniform_map_up_to_its_rim():
    edges = np.linspace(-10, 10, 81)
    centres = (edges[1:] + edges[:-1]) / 2
    inside = np.hypot(*np.meshgrid(centres, centres)) < 9
    map = DetectorMap.from_array(np.where(inside, 3.0, np.nan), edges, edges)
    assert np.array_equal(map.mask, inside)
    np.testing.assert_allclose(map.smoothed(1.0).density[inside], 1, rtol=1e-12)
    with pytest.raises(ValueError, match="counts"):
        map.counts  # noqa: B018


def test_smoothing_is_a_gaussian_of_the_width_asked_for():
    # bins of 0.25 x 0.5 mm: the width is one of millimetres, not of bins
    x_edges, y_edges = np.arange(-20, 20.1, 0.25), np.arange(-20, 20.1, 0.5)
    values = np.zeros((80, 160))
    values[40, 80] = 1
    map = DetectorMap.from_array(values, x_edges, y_edges).smoothed(1.5)
    for axis, centre in ((0, map.centres[0]), (1, map.centres[1])):
        weight = map.values.sum(axis)
        mean = (weight * centre).sum() / weight.sum()
        sigma = np.sqrt((weight * (centre - mean) ** 2).sum() / weight.sum())
        # the filter is cut off at 4 sigma, which takes 0.1 % off its variance
        assert sigma == pytest.approx(1.5, rel=2e-3)
    assert map.smoothed(2.0).smoothing == pytest.approx(2.5)


@pytest.mark.parametrize("sigmas", [(0.0, 40.0), (1.5, 9.0)], ids=["none and wide", "usual"])
def test_the_filter_has_the_bits_of_scipy(sigmas):
    values = np.random.default_rng(3).random((2, 50, 30))
    for maps in (values, values.swapaxes(1, 2), np.arange(12.0).reshape(3, 4)):
        expected = scipy.ndimage.gaussian_filter(maps, sigmas, mode="constant", truncate=3.0, axes=(-2, -1))
        np.testing.assert_array_equal(gaussian(maps, sigmas, 3.0), expected)


def test_bad_arguments_are_named():
    x, y = disc(1000)
    hits = Hits(x=x, y=y)
    even, uneven = np.arange(4.0), np.array([0, 1, 2, 4.0])
    cases = [
        (lambda: hits.map(bins=0), "bins must be an integer"),
        (lambda: hits.map(extent=(1, 0, 0, 1)), "extent must be"),
        (lambda: hits.map(extent=(50, 60, 50, 60)), "none of 1,000 hits"),
        (lambda: hits.map(mask=np.ones((2, 2), bool)), "mask must have shape"),
        (
            lambda: Hits(x=[1.0], y=[2.0]).map(),
            r"the only ion lies at \(1, 2\) mm: .* select more ions or give ext",
        ),
        (lambda: Hits(x=[1.0] * 3, y=[2.0] * 3).map(), r"all 3 ions lie at \(1, 2\) mm"),
        (lambda: hits.map(extent=(1, 1, 2, 2)), "with a non-zero size"),
        (lambda: Hits(x=[np.nan], y=[1.0], source="f").map(), "got none of 1 in f"),
        (lambda: hits.map().smoothed(-1), "sigma must be"),
        (lambda: hits.map().flattened(-1), "sigma must be"),
        (lambda: hits.map().flattened(1e4), "sigma must be"),  # wider than the map: 1e9 would take all memory
        (
            lambda: DetectorMap.from_array(np.ones((3, 3)), even, uneven),
            "y_edges must increase in even steps",
        ),
        (lambda: DetectorMap.from_array(np.ones((3, 2)), even, even), "x_edges must have shape"),
        (lambda: DetectorMap.from_array(-np.ones((3, 3)), even, even), "values of a map must be >= 0, got -1"),
        (lambda: DetectorMap.from_array(np.full((3, 3), np.nan), even, even), "mask must contain"),
    ]
    for call, message in cases:
        with pytest.raises(ValueError, match=message):
            call()


def test_pictures_share_a_scale_and_state_what_they_show(tmp_path):
    x, y = disc(20_000)
    map = Hits(x=x, y=y).map(bins=64)
    ax = plot.detector_map(map, title="uniform")
    assert ax.get_xlabel() == "x [mm]" and any("ions" in text.get_text() for text in ax.findobj(Text))
    ax.figure.savefig(tmp_path / "a.png")
    axes = plot.detector_maps([map, map.smoothed(1.0)], ["as it is", "smoothed"])
    assert len({ax.images[0].get_clim() for ax in axes}) == 1
    low, high = color_limits(map)
    assert low < 1 < high and "smoothed by 1 mm" in describe(map.smoothed(1.0))
    with pytest.raises(ValueError, match="one title per map"):
        plot.detector_maps([map], ["a", "b"])


def test_what_lies_outside_is_counted():
    x, y = disc(100_000)
    map = Hits(x=np.append(x, 13.0), y=np.append(y, 0.0)).map(bins=175)
    inside = int(map.counts[map.mask].sum())
    for each in (map, map.smoothed(0.5), map.flattened(5.0)):
        assert describe(each).startswith(f"{inside:,} of 100,001 ions, ") and "of 100,001 ions" in repr(each)
    whole = Hits(x=x, y=y).map(bins=4, mask=np.ones((4, 4), bool))
    assert describe(whole).startswith("100,000 ions, ")


@pytest.mark.skipif(not SILICON.exists(), reason="the measured Si.epos is not there")
def test_measured_map_shows_no_stripes():
    hits = read(SILICON)

    def stripes(map):
        """Scatter over Poisson of second differences, which leave out what varies slowly."""
        ny, nx = map.counts.shape
        totals = map.counts[ny // 4 : 3 * ny // 4, nx // 4 : 3 * nx // 4].sum(0).astype(float)
        return np.diff(totals, 2).std() / np.sqrt(6 * totals.mean())

    # some 100 totals: the scatter of a standard deviation is 7 %, plus what structure is left
    assert stripes(hits.map()) < 1.3 and stripes(hits.map(dither_seed=1)) < 1.3
    assert stripes(hits.map(position_step=None)) > 5


def test_a_map_is_an_array_for_numpy_and_xarray():
    values = np.arange(6.0).reshape(2, 3)
    map = DetectorMap.from_array(values, [0, 2, 4, 6], [0, 1, 2], mask=values > 0, is_counts=True, source="a file")
    assert np.asarray(map).tolist() == values.tolist() and np.asarray(map, "f4").dtype == np.float32
    assert np.shares_memory(np.asarray(map), map.values) and not np.shares_memory(np.array(map), map.values)
    xarray = pytest.importorskip("xarray")
    labelled = map.to_xarray()
    assert isinstance(labelled, xarray.DataArray) and labelled.dims == ("y", "x") and labelled.name == "hits"
    assert labelled.x.values.tolist() == [1, 3, 5] and labelled.y.values.tolist() == [0.5, 1.5]
    assert labelled.x.attrs["units"] == "mm" and labelled.attrs["ions"] == 15 and labelled.attrs["source"] == "a file"
    np.testing.assert_array_equal(labelled.values, np.where(values > 0, values, np.nan))
