import datetime
import math
import tomllib

import pytest
from hypothesis import given
from hypothesis import strategies as st

from apt_evap.simulation.config.toml_text import comment, toml_text

TEXT = st.text(st.characters(codec="utf-8"))
NUMBERS = st.booleans() | st.integers(-(2**63), 2**63 - 1) | st.floats(allow_nan=False)
PLAIN = NUMBERS | TEXT
VALUES = st.recursive(PLAIN, lambda inner: st.lists(inner) | st.dictionaries(TEXT, inner), max_leaves=8)


@given(st.dictionaries(TEXT, VALUES))
def test_settings_come_back(document):
    assert tomllib.loads(toml_text(document)) == document


def test_a_file_reads_like_one_written_by_hand():
    document = {"output": "x.h5", "tip": {"material": "Ni", "axis": [0, 0, 1]}, "simulation": {"ions": 3}}
    assert toml_text(document) == (
        'output = "x.h5"\n\n[tip]\nmaterial = "Ni"\naxis = [0, 0, 1]\n\n[simulation]\nions = 3\n'
    )


def test_nan():
    assert math.isnan(tomllib.loads(toml_text({"x": math.nan}))["x"])


def test_other_types_are_refused():
    with pytest.raises(ValueError, match=r"texts, numbers, booleans, lists and tables, got datetime.date"):
        toml_text({"day": datetime.date(2026, 1, 1)})


@given(st.text())
def test_a_comment_is_one_line_without_content(text):
    written = f"{comment(text)}\nx = 1\n"
    assert tomllib.loads(written.encode().decode()) == {"x": 1} and written.count("\n") == 2


def test_text_that_is_not_unicode_is_refused():
    with pytest.raises(ValueError, match="Unicode"):
        toml_text({"output": "caf\udce9.h5"})
