"""What is kept is used again only for what it was made from."""

import pytest

import apt_evap as ae
from apt_evap._common.codec import to_plain
from apt_evap._common.kept import check_made_from, digest_of, first_difference


@pytest.mark.parametrize(
    ("kept", "asked", "name"),
    [
        ({"tip": {"radius": 2.5}}, {"tip": {"radius": 2.6}}, "tip.radius"),
        ({"axis": [0, 0, 1]}, {"axis": [0, 1, 1]}, "axis.1"),
        ({"axis": [0, 0, 1]}, {"axis": [0, 0]}, "axis"),
        ({"a": 1, "b": 2}, {"a": 1}, "b"),
        ({"a": 1}, {"a": 1, "b": 2}, "b"),
        ({"a": None}, {"a": 0}, "a"),
        ({"a": 1}, {"a": True}, "a"),
        ({"a": "1"}, {"a": 1}, "a"),
        ({"seed": 10**18}, {"seed": 10**18 + 1}, "seed"),
        ({"a": 10**400}, {"a": 1.0}, "a"),
        ([], {}, "content"),
    ],
)
def test_the_first_difference_is_named(kept, asked, name):
    assert first_difference(kept, asked)[0] == first_difference(asked, kept)[0] == name
    with pytest.raises(ae.FileError, match=f"^'set' was made with {name} = .* is asked for: remove it$"):
        check_made_from("set", kept, asked, "remove it")


@pytest.mark.parametrize(
    ("kept", "asked"),
    [
        ({"a": 1, "b": [1.0, None]}, {"b": [1, None], "a": 1.0}),
        ({"a": 0.1 + 0.2}, {"a": 0.3}),  # rounding
        ({"a": float("nan")}, {"a": float("nan")}),
        (to_plain(ae.Instrument(efficiency=0.3)), ae.Instrument(efficiency=0.3)),
    ],
)
def test_equal_things_have_no_difference(kept, asked):
    check_made_from("set", kept, asked, "remove it")


def test_the_digest_is_that_of_the_content():
    settings = ae.Instrument(efficiency=0.3)
    assert digest_of(settings) == digest_of(to_plain(settings)) == digest_of(dict(reversed(to_plain(settings).items())))
    assert digest_of(settings) != digest_of(ae.Instrument(efficiency=0.31))


def test_rounding_of_a_sum_is_no_difference_and_another_number_is():
    assert first_difference({"a": [0.1 + 0.2]}, {"a": [0.3]}) is None
    assert first_difference({"a": [0.3]}, {"a": [0.3 * (1 + 1e-6)]})[0] == "a.0"
