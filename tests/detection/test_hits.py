import numpy as np
import pytest

from apt_evap.detection.hits import Hits, Outcome


def simulated():
    return Hits(
        x=[0.0, 1.0, np.nan, 3.0],
        y=[0.0, -1.0, np.nan, 2.0],
        site=[7, 5, 3, 1],
        ion=[0, 1, 2, 3],
        outcome=[Outcome.HIT, Outcome.MISSED, Outcome.NEVER_LEFT, Outcome.HIT],
        source="a test",
    )


def test_columns_keep_single_precision_and_become_native():
    hits = Hits(x=np.array([1.5, 2.5], ">f4"), y=np.array([1, 2]), pulses=[0, 1], pulse_id=np.array([3, 4], "u1"))
    assert hits.x.dtype == np.dtype("f4") and hits.x.dtype.isnative
    assert hits.y.dtype == np.float64
    assert hits.pulses.dtype == np.uint32 and hits.pulse_id.dtype == np.int64
    assert hits.x.tolist() == [1.5, 2.5]


def test_detected_needs_a_hit_and_finite_coordinates():
    assert simulated().detected.tolist() == [True, False, False, True]
    assert Hits(x=[0.0, np.inf, 1.0], y=[np.nan, 0.0, 1.0]).detected.tolist() == [False, False, True]
    assert Hits(positions=np.zeros((2, 3))).detected.all()


def test_counts_name_every_outcome():
    assert simulated().counts == {Outcome.HIT: 2, Outcome.MISSED: 1, Outcome.NEVER_LEFT: 1, Outcome.OUTSIDE: 0}
    assert Hits(x=[1.0, 2.0]).counts[Outcome.HIT] == 2


@pytest.mark.parametrize(
    "selection, expected",
    [
        (slice(1, 3), [5, 3]),
        ([True, False, False, True], [7, 1]),
        (np.array([3, 0]), [1, 7]),
        (-1, [1]),
        ([], []),
        (np.zeros(4, bool), []),
    ],
)
def test_selection_keeps_type_columns_and_source(selection, expected):
    chosen = simulated()[selection]
    assert isinstance(chosen, Hits) and len(chosen) == len(expected)
    assert chosen.site.tolist() == expected
    assert chosen.columns == simulated().columns and chosen.source == "a test"
    assert chosen.site.dtype == np.int64 and chosen.outcome.dtype == np.int8


@pytest.mark.parametrize("selection", [[True, False], "x", 1.5, np.zeros((2, 2), int)])
def test_selection_by_anything_else_is_an_error(selection):
    with pytest.raises(ValueError, match="mask"):
        simulated()[selection]


@pytest.mark.parametrize("name", ["extra", "units"])
def test_further_columns_have_names(name):
    with pytest.raises(ValueError, match=f"a name in {name} must be text, got 1"):
        Hits(x=[1.0], **{name: {1: [1.0]}})


def test_missing_column_names_column_and_source():
    with pytest.raises(ValueError, match=r"a test has no column 'voltage'"):
        simulated().require("x", "voltage")
    with pytest.raises(ValueError, match="no column 'colour'"):
        simulated().require("colour")
    x, site = simulated().require("x", "site")
    assert x[1] == 1.0 and site[1] == 5


@pytest.mark.parametrize(
    "columns, message",
    [
        ({}, "at least one column"),
        ({"x": [1.0], "y": [1.0, 2.0]}, "x 1, y 2"),
        ({"x": [[1.0]]}, r"x must have shape \(n,\)"),
        ({"positions": np.zeros((3, 2))}, r"positions must have shape \(n, 3\)"),
        ({"pulses": [-1]}, "pulses must contain integers"),
        ({"site": [0.5]}, "site must contain integers"),
        ({"outcome": [4]}, "outcome must be"),
        ({"x": ["far"]}, "x must be an array of numbers"),
    ],
)
def test_bad_columns_are_named(columns, message):
    with pytest.raises(ValueError, match=message):
        Hits(**columns)


def test_repr_says_what_it_holds():
    text = repr(simulated())
    for part in ("4 ions", "2 detected", "'a test'", "site", "outcome"):
        assert part in text
    assert "voltage" not in text


def test_map_counts_the_detected_ions_only():
    assert simulated().map(bins=4).counts.sum() == 2
