"""Masked values of NumPy are missing values; they are never read as the numbers below the mask."""

import numpy as np
import pytest

import apt_evap as ae
from apt_evap._common.validation import check_array, check_values
from apt_evap.detection.timing import mass_to_charge
from apt_evap.spectra.mass_ranges import Ranges

MASKED = np.ma.array([1.0, -999.0, 3.0], mask=[False, True, False])
MEANT = [1.0, np.nan, 3.0]


def test_masked_values_of_real_columns_are_nan():
    hits = ae.Hits(x=MASKED, y=MASKED.astype(np.float32), voltage=np.ma.array([1, 2, 3], mask=MASKED.mask))
    np.testing.assert_array_equal(hits.x, MEANT)
    np.testing.assert_array_equal(hits.y, MEANT)
    np.testing.assert_array_equal(hits.voltage, [1.0, np.nan, 3.0])
    assert hits.y.dtype == np.float32 and hits.detected.tolist() == [True, False, True]
    assert not np.ma.isMaskedArray(hits.x)
    rows = np.ma.array(np.ones((3, 3)), mask=[[0, 0, 0], [0, 1, 0], [0, 0, 0]])
    for positions in (rows, list(rows)):
        hits = ae.Hits(positions=positions, extra={"energy": MASKED})
        assert np.isnan(hits.positions).sum() == 1 and np.isnan(hits.positions[1, 1])
        np.testing.assert_array_equal(hits.extra["energy"], MEANT)
    np.testing.assert_array_equal(check_values(MASKED, "x", finite=False), MEANT)
    assert np.isnan(mass_to_charge(5e3, 500.0, MASKED, 0.0, 100.0)).tolist() == [False, True, False]


@pytest.mark.parametrize("name", ["pulse_id", "multiplicity", "outcome", "site", "pulses"])
def test_masked_integers_are_refused(name):
    dtype = getattr(ae.Hits(**{name: [0, 1, 0]}), name).dtype
    masked = np.ma.array([0, 1, 0], mask=[0, 1, 1], dtype=dtype)
    with pytest.raises(ValueError, match=f"{name} must have no masked values, got 2 of 3"):
        ae.Hits(**{name: masked})
    clear = np.ma.array([0, 1, 0], mask=False, dtype=dtype)
    assert getattr(ae.Hits(**{name: clear}), name).tolist() == [0, 1, 0]


def test_masked_values_elsewhere_are_refused_by_name():
    tip = ae.Tip("Ni", apex_radius=1.0)
    hole = np.zeros(len(tip), bool)
    hole[5] = True
    rows = np.ma.array(tip.positions, mask=np.repeat(hole[:, None], 3, axis=1))
    with pytest.raises(ValueError, match="positions must be finite, got nan"):
        ae.Tip.from_positions(rows, tip.species, ["Ni"])
    with pytest.raises(ValueError, match="species must have no masked values, got 1"):
        ae.Tip.from_positions(tip.positions, np.ma.array(tip.species, mask=hole), ["Ni"])
    with pytest.raises(ValueError, match="low must be finite, got nan"):
        Ranges(["A", "B", "C"], MASKED, [5.0, 6.0, 7.0])
    with pytest.raises(ValueError, match="a selection of Hits must have no masked values"):
        ae.Hits(x=[1.0, 2.0])[np.ma.array([True, True], mask=[True, False])]
    with pytest.raises(ValueError, match=r"extra\['number'\] must have no masked values"):
        ae.Hits(x=[1.0, 2.0], extra={"number": np.ma.array([1, 2], mask=[True, False])})
    with pytest.raises(ValueError, match="a must be finite"):
        check_array(MASKED, "a", ("n",))
    with pytest.raises(ValueError, match="charge_state must be"):
        ae.material("Ni", charge_state=np.ma.masked)


def test_masked_bins_of_a_map_are_outside():
    edges = np.arange(4.0)
    values = np.ma.array(np.ones((3, 3)), mask=np.eye(3, dtype=bool))
    assert (ae.DetectorMap.from_array(values, edges, edges).mask == ~np.eye(3, dtype=bool)).all()
