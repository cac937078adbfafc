"""What is not loaded until it is used: help, and the first line of a script, must come at once."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

import apt_evap as ae

ROOT = Path(ae.__file__).parents[1]
DRAWING = ("matplotlib", "PIL")
NUMBERS = ("numpy", "h5py", "scipy", "skimage", "tqdm", "apt_evap.simulation", "apt_evap._core")
# these have parts that take longer to load than the whole of this package
IMAGES = tuple(f"skimage.{part}" for part in ("feature", "filters", "measure", "metrics", "morphology", "transform"))
NUMERICS = ("fft", "interpolate", "linalg", "ndimage", "optimize", "spatial", "special")
SLOW = IMAGES + tuple(f"scipy.{part}" for part in NUMERICS)
HELP = "from apt_evap.cli.main import main; assert main({}) == 0"


def loaded(code):
    """Names of the modules that a new Python has loaded after some code."""
    code = f"import sys, os\nbefore = os.dup(1); os.dup2(2, 1)\n{code}\nsys.stdout.flush(); os.dup2(before, 1)\n"
    return set(printed(code + "print(*sys.modules)").split())


def printed(code):
    """What some code prints in a new Python."""
    environment = os.environ | {"PYTHONPATH": str(Path(ae.__file__).parents[1])}
    command = [sys.executable, "-P", "-c", code]
    return subprocess.run(command, capture_output=True, text=True, env=environment, check=True).stdout


@pytest.mark.parametrize(
    ("code", "unwanted"),
    [
        ("import apt_evap", DRAWING + NUMBERS),
        (HELP.format("['--help']"), DRAWING + NUMBERS),
        (HELP.format("['--version']"), DRAWING + NUMBERS),
        ("from apt_evap.cli.parser import make_parser; make_parser().format_help()", DRAWING + NUMBERS),
        ("import apt_evap as ae\nae.Tip, ae.Simulation, ae.RollUp, ae.load, ae.read, ae.plot", DRAWING + SLOW),
        # without that of a companion, which needs what its data sets are made with
        ("import apt_evap as ae\n[getattr(ae, name) for name in {*ae.__all__} - {'load_dataset'}]", DRAWING + SLOW),
    ],
    ids=["package", "help", "version", "options of all commands", "first use", "every name"],
)
def test_what_is_loaded(code, unwanted):
    found = loaded(code)
    assert "apt_evap" in found and "lazy_loader" in found
    assert found.intersection(unwanted) == set()


def test_what_a_map_loads():
    """A similarity and a convex outline load their parts of scikit-image, a map with a known mask none."""
    lines = (
        "import numpy as np, apt_evap as ae",
        "hits = ae.Hits(x=np.tile(np.linspace(-9, 9, 40), 40), y=np.repeat(np.linspace(-9, 9, 40), 40))",
        "map = hits.map(bins=20, position_step=None, mask=np.ones((20, 20), bool))",
    )
    images = f"print(*({{*sys.modules}} & {set(IMAGES)}))"
    steps = ("import sys", *lines, images, "ae.similarity(map, map)", images, "hits.map(bins=20)", images)
    first, second, third = (set(line.split()) for line in printed("\n".join(steps)).splitlines())
    assert first == set() and second == {"skimage.metrics"} and "skimage.morphology" in third


@pytest.mark.slow
def test_what_the_picture_of_a_run_loads(small_tip, made_once, tmp_path):
    made_once(small_tip, 250, voltage=1000.0, seed=2).save(tmp_path / "run.h5")
    found = loaded(HELP.format(["map", f"{tmp_path}/run.h5", "-o", f"{tmp_path}/map.png"]))
    assert (tmp_path / "map.png").exists() and "matplotlib" in found
    others = ("apt_evap.fit", "apt_evap.maps.indexing", "apt_evap.simulation.simulation")
    assert found.intersection(SLOW + others) == set()


def test_the_test_sees_what_is_loaded():
    assert {"matplotlib", "scipy.optimize"} <= loaded("import matplotlib, scipy.optimize")


@pytest.mark.parametrize(
    ("code", "seconds"),
    [
        ("import apt_evap", 0.15),
        (HELP.format("['--help']"), 0.15),
        ("import apt_evap as ae\nae.load('run.h5').hits(ae.RollUp(0.2)).map()", 1.0),
    ],
    ids=["package", "help", "first map of a run"],
)
def test_the_start_is_short(small_tip, made_once, tmp_path, code, seconds):
    """Processor time; one of five will do, because other programs make each longer and none shorter."""
    made_once(small_tip, 250, voltage=1000.0, seed=2).save(tmp_path / "run.h5")
    code = f"import os\nos.chdir({str(tmp_path)!r})\n{code}\nimport time\nprint(time.process_time())"
    assert any(float(printed(code).split()[-1]) < seconds for _ in range(5))
