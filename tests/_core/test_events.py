"""The table of events: its columns are those declared, and it is filled from call to call."""

import inspect
import re

import numpy as np
import pytest

import apt_evap as ae
from apt_evap._core.evaporation import DONE, SWEEP_DUE
from apt_evap._core.events import COLUMNS, Events
from apt_evap.evaporation.emitter import Batch

FIXED = ae.evaporation.ChargeSettings(potential_bound=1.0)  # no relaxation before an interval ends


def test_columns_are_those_declared(small_tip):
    emitter = ae.evaporation.Emitter(small_tip, settings=FIXED)
    events = Events(small_tip.positions, 40)
    assert events.journal.n_events == 0 and all(len(each) == 0 for each in events.columns().values())
    assert emitter._core.evaporate(events, 30) == SWEEP_DUE
    assert events.journal.n_events == 30
    columns = events.columns()
    assert list(columns) == [column.name for column in COLUMNS]
    for column in COLUMNS:
        array = columns[column.name]
        assert array.dtype == column.dtype and array.shape == (30, *column.row), column.name
        assert array.flags.c_contiguous, column.name


def test_a_table_is_filled_from_call_to_call(small_tip):
    emitter, twin = (ae.evaporation.Emitter(small_tip, settings=FIXED) for _ in range(2))
    events = Events(small_tip.positions, 40)
    assert emitter._core.evaporate(events, 30) == SWEEP_DUE
    first = events.columns()
    emitter.relax_due()
    assert emitter._core.evaporate(events, 30) == DONE
    assert emitter._core.evaporate(events, 30) == DONE  # a full table takes no more
    assert events.journal.n_events == emitter.counts["events"] == 40
    twin.sweep_interval = 30
    batches = list(twin.advance(40))
    assert [len(batch) for batch in batches] == [30, 10]
    for name, array in events.columns().items():
        assert np.array_equal(array[:30], first[name]), name
        if name not in ("waits", "rises"):
            assert np.array_equal(array, np.concatenate([batch.columns[name] for batch in batches])), name


def test_columns_do_not_share_memory_with_the_table(small_tip):
    events = Events(small_tip.positions, 5)
    ae.evaporation.Emitter(small_tip)._core.evaporate(events, 100)
    one, other = events.columns(), events.columns()
    for name, array in one.items():
        assert not np.shares_memory(array, other[name]), name


def test_a_batch_describes_every_column():
    described = set(re.findall(r"^(\w+) : ", inspect.getdoc(Batch), re.MULTILINE))
    assert described | {"waits"} == set(Batch.__annotations__)


def test_a_batch_has_every_column(small_tip):
    (batch,) = ae.evaporation.Emitter(small_tip).advance(5)
    assert set(batch.columns) == {column.name for column in COLUMNS}
    for name, values in batch.columns.items():
        assert len(values) == 5, name
        if name in Batch.__annotations__ and name != "waits":  # which needs a control
            assert getattr(batch, name) is values, name


def test_a_table_needs_an_array_of_positions():
    with pytest.raises(ValueError, match="dimensions"):
        Events(np.zeros(3), 5)
