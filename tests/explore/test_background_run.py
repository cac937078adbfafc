"""A run in a process of its own: the bits of the same run here; it is stopped, continued, and replaces nothing."""

import time

import numpy as np
import pytest

import apt_evap as ae
from apt_evap.explore.background_run import BackgroundRun
from apt_evap.simulation.config.simulation_file import read_config

SECONDS = 120  # until a test gives up: the machine may be busy
SETTINGS = """
[tip]
material = "Ni"
apex_radius = "9 a"
axis = [0.3, 0.5, 0.8]
shank_length = "6 a"
[simulation]
ions = {ions}
"""


def ended(run):
    end = time.monotonic() + SECONDS
    while run.active:
        assert time.monotonic() < end, run.message
        time.sleep(0.01)
    return run


def settings(folder, ions):
    (folder / "tip.toml").write_text(SETTINGS.format(ions=ions))
    return folder / "tip.toml"


@pytest.mark.slow
def test_the_run_is_that_of_the_settings(tmp_path):
    path = settings(tmp_path, 300)
    run = ended(BackgroundRun(path, tmp_path / "tip.h5"))
    assert run.finished and run.message == "" and run.ions == run.n_ions == 300
    config = read_config(path)
    expected = config.simulation().run(300, config.emissions, responses=config.responses, progress=False)
    found = ae.load(tmp_path / "tip.h5")
    assert np.array_equal(found.site, expected.site) and np.array_equal(found.voltages, expected.voltages)
    # a complete run is not made again
    again = ended(BackgroundRun(path, tmp_path / "tip.h5"))
    assert again.finished and again.n_ions == 300
    # another one is not replaced
    path.write_text(path.read_text().replace("0.8", "0.7"))
    refused = ended(BackgroundRun(path, tmp_path / "tip.h5"))
    assert not refused.finished and "tip.h5" in refused.message
    assert len(ae.load(tmp_path / "tip.h5")) == 300


@pytest.mark.slow
def test_a_stopped_run_is_continued(tmp_path):
    path = settings(tmp_path, 3_000)
    run = BackgroundRun(path, tmp_path / "tip.h5")
    end = time.monotonic() + SECONDS
    while run.ions < 100 and run.active:
        assert time.monotonic() < end
        time.sleep(0.005)
    assert run.n_ions == 3_000
    run.stop()
    ended(run)
    assert not run.finished
    there = len(ae.load(tmp_path / "tip.h5"))
    assert 100 <= there < 3_000 and f"{there:,}" in run.message
    (tmp_path / "tip.toml").write_text(SETTINGS.format(ions=there + 50))
    assert ended(BackgroundRun(path, tmp_path / "tip.h5")).finished
    assert len(ae.load(tmp_path / "tip.h5")) == there + 50


def test_bad_settings_are_said(tmp_path):
    path = settings(tmp_path, 10)
    path.write_text(path.read_text().replace("Ni", "Xx"))
    run = ended(BackgroundRun(path, tmp_path / "tip.h5"))
    assert not run.finished and "Xx" in run.message and run.seconds_left is None


@pytest.mark.slow
@pytest.mark.parametrize("moment", ["building", "running"])
def test_a_run_is_stopped_at_any_moment(tmp_path, moment):
    run = BackgroundRun(settings(tmp_path, 200_000), tmp_path / "tip.h5")
    while moment == "running" and not run.n_ions:
        time.sleep(0.01)
    run.stop(wait=True)
    assert not run.active and not run.finished
