"""Parts of a run: selected rows stay in the sequence of evaporation, and only parts of one run are joined."""

import itertools
import re
import tracemalloc
from dataclasses import replace

import numpy as np
import pytest

import apt_evap as ae
from apt_evap import Run
from apt_evap.simulation.columns import columns_of
from apt_evap.simulation.packed_parts import PackedParts

ROLLED = ae.RollUp(0.1)
LENS = ae.detection.LocalElectrode.preset("local electrode")


@pytest.fixture(scope="session")
def run(small_tip):
    return ae.Simulation(small_tip, seed=1, n_threads=1).run(150, progress=False)


@pytest.fixture(scope="session")
def real(run):
    return run.at_evaporation_field()


@pytest.mark.parametrize(
    "rows", [slice(10, 60), slice(None, None, 3), [3, 5, 99], [], [-1], slice(0, 0), np.arange(150) % 4 == 0]
)
def test_hits_of_a_part_are_part_of_the_hits(real, rows):
    part, whole = real[rows].hits(ROLLED), real.hits(ROLLED)[np.arange(150)[rows]]
    for name in ("x", "y", "time_of_flight", "voltage", "pulse_id", "ion"):
        assert np.array_equal(getattr(part, name), getattr(whole, name), equal_nan=True), name
    hit = part.outcome == ae.detection.Outcome.HIT
    # pulses since the last selected ion, and selected ions of a pulse
    pulses = part.pulse_id[hit].tolist()
    assert part.pulses[hit].tolist() == [b - a for a, b in zip([*pulses[:1], *pulses], pulses, strict=False)]
    assert part.multiplicity[hit].tolist() == [pulses.count(pulse) for pulse in pulses]


@pytest.mark.parametrize("rows", [slice(None, None, -1), [5, 3], [7, 7], [-1, 0], np.arange(150)[::-1]])
def test_rows_in_another_order_are_refused(run, real, rows):
    for each in (run, real):
        with pytest.raises(
            ValueError, match=r"^rows must be in the sequence of evaporation, each once, got ion \d+ after"
        ):
            each[rows]


@pytest.mark.parametrize(
    "rows", [5, -1, np.int64(5), 5.0, "a", None, ..., [0.5], ["a"], [[1, 2]], (slice(3), 2), {1: 2}]
)
def test_other_rows_are_refused_in_one_sentence(run, rows):
    with pytest.raises(ValueError, match=r"^rows must be a slice, a mask or indices such as \[5\], got [^\n]+$"):
        run[rows]


@pytest.mark.parametrize("rows", [[150], [-151], [True] * 149])
def test_rows_that_do_not_exist(run, rows):
    with pytest.raises(IndexError):
        run[rows]


def test_a_file_with_rows_in_another_order_is_refused(run, real, tmp_path):
    """Such as a file that another program has written."""
    turned = replace(run, emissions=replace(run.emissions, ions=run.emissions.ions[::-1].copy()))
    turned.save(tmp_path / "turned.h5")
    with pytest.raises(ae.FileError, match=r"turned.h5.*ions must be in the sequence of evaporation"):
        ae.load(tmp_path / "turned.h5")
    pulses = real.real._replace(pulse_ids=real.real.pulse_ids[::-1].copy())
    replace(real, real=pulses).save(tmp_path / "pulses.h5")
    with pytest.raises(ae.FileError, match=r"pulses.h5.*pulse_ids must not decrease"):
        ae.load(tmp_path / "pulses.h5")


# ---- join ----------------------------------------------------------------------------------------------------------


@pytest.mark.slow
@pytest.mark.parametrize(
    "cuts", [[], [0, 75, 150], *(pytest.param(cuts, marks=pytest.mark.slow) for cuts in ([50], [50, 90]))]
)
def test_parts_are_joined_to_the_whole(run, cuts):
    bounds = [0, *cuts, len(run)]
    joined = Run.join([run[first:last] for first, last in itertools.pairwise(bounds)])
    assert joined.fingerprint() == run.fingerprint()
    for name in ("cap", "history"):
        for one, two in zip(getattr(joined, name), getattr(run, name), strict=True):
            assert np.array_equal(one, two, equal_nan=True)
    one, two = (each.at_evaporation_field(LENS) for each in (joined, run))
    assert np.array_equal(one.voltages, two.voltages)
    assert np.array_equal(one.hits(ROLLED).x, two.hits(ROLLED).x, equal_nan=True)


def test_only_parts_of_one_run_are_joined(run, real, small_tip, tip12):
    tungsten = ae.Simulation(ae.Tip("W", 2.1, (1, 1, 1), shank_length=2.1), seed=1, n_threads=1).run(5, progress=False)
    seed = ae.Simulation(small_tip, seed=2, n_threads=1).run(5, progress=False)
    flown = ae.Simulation(small_tip, seed=1, n_threads=1).run(5, [ROLLED], progress=False)
    for other, what in (
        (tungsten, "settings"),
        (seed, "settings"),
        (flown, "perturbations"),
        (real[100:], "real units"),
        (replace(run[100:], responses=None), "responses"),
        (real[100:].at_evaporation_field(smoothing=3), "real units"),
    ):
        first = real if other.units is not None and what == "real units" and other.units != real.units else run
        with pytest.raises(ValueError, match=re.escape(f"runs[1] whose {what} differ from runs[0]")):
            Run.join([first[:100], other])


@pytest.mark.parametrize("parts", [[(50, 90), (0, 50)], [(0, 50), (0, 50)], [(0, 60), (50, 90)]])
def test_parts_must_follow_one_another(run, parts):
    with pytest.raises(ValueError, match=r"^ions of the joined runs must be in the sequence of evaporation, each once"):
        Run.join([run[slice(*part)] for part in parts])


@pytest.mark.parametrize(
    ("parts", "message"),
    [
        ([], "runs must be at least one part of a run, got none"),
        (5, "runs must be a sequence of parts of a run, got 5"),
        ([5], "runs[0] must be a Run, got 5"),
    ],
)
def test_what_is_no_parts_is_refused(parts, message):
    with pytest.raises(ValueError, match=f"^{re.escape(message)}$"):
        Run.join(parts)


def test_masked_rows_are_refused(few20):
    """As by `Hits`: a row that is masked is neither selected nor left out."""
    mask = np.arange(len(few20)) % 2 == 0
    for rows in (np.ma.array(~mask, mask=mask), np.ma.array(np.arange(3), mask=[False, True, False])):
        with pytest.raises(ValueError, match="rows"):
            few20[rows]
    assert len(few20[np.ma.array(mask)]) == mask.sum()


def bits_of(run):
    """Bytes of each column of a run."""
    return {path: (values.dtype.str, values.tobytes()) for path, values in columns_of(run, run.every_column).items()}


@pytest.mark.parametrize("cuts", [(0, 150), (0, 1, 80, 150), (0, 0, 150, 150)])
def test_packed_parts_are_the_parts_bit_by_bit(run, cuts):
    parts = [run[a:b] for a, b in itertools.pairwise(cuts)]
    packed = PackedParts()
    for part in parts:
        packed.add(part)
    joined = Run.join(parts)
    for last in (False, True):
        assert len(packed) == 150
        unpacked = packed.run(last=last)
        assert bits_of(unpacked) == bits_of(joined)
        assert unpacked.fingerprint() == run.fingerprint()
        for name in ("history", "cap", "provenance", "settings", "perturbations", "elements", "state", "first_event"):
            assert repr(getattr(unpacked, name)) == repr(getattr(joined, name)), name
    assert len(packed) == 0


def test_packed_parts_keep_every_bit_of_a_number(run):
    """Not a number has many bits, and zero has a sign."""
    site = run.responses.site.copy()
    site[:3, 0, 0] = np.array([0x7FC00001, 0xFFC12345, 0x80000000], np.uint32).view(np.float32)
    packed = PackedParts()
    packed.add(replace(run, responses=replace(run.responses, site=site)))
    assert packed.run(last=True).responses.site.tobytes() == site.tobytes()


def test_ions_of_packed_parts_take_less_than_0_7_kilobytes(run):
    packed = PackedParts()
    packed.add(run)
    size = sum(len(part.memory) for part in packed._parts) / len(run)
    whole = sum(values.nbytes for values in columns_of(run, run.every_column).values()) / len(run)
    assert size < 700 < 1400 < whole


def test_packed_parts_are_joined_without_a_second_copy(few20):
    """Joining needs the memory of the run, beside that of the packed parts, which is not traced."""
    whole = sum(values.nbytes for values in columns_of(few20, few20.every_column).values())
    peaks = []
    for last in (True, False):
        packed = PackedParts()
        for start in range(0, len(few20), 1500):
            packed.add(few20[start : start + 1500])
        tracemalloc.start()
        packed.run(last=last)
        peaks.append(tracemalloc.get_traced_memory()[1])
        tracemalloc.stop()
        assert len(packed) == (0 if last else len(few20))
    assert max(peaks) < 1.3 * whole
