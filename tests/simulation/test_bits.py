"""A run has the same bits on every processor, with every BLAS, and with every choice that NumPy and the C library make.

The fingerprint below was first computed on one machine. It changes when the model changes, never otherwise.
"""

import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

import apt_evap as ae
from apt_evap.simulation.config.simulation_file import read_config

FINGERPRINT = "8ac7da36b7295f3a877443fb7d7562ad3001102023c722c2de1eaf991997334c"
PROGRAM = """
import warnings

import apt_evap as ae

warnings.simplefilter("ignore")
nickel = ae.material("Ni")
tip = ae.Tip(
    nickel, 5 * nickel.a, (1, 2, 3), solutes={"Al": 0.1}, seed=3, offset_seed=4, shank_angle=2.3, rotation=17.0
)
flown = ae.LateralVelocity(ae.TruncatedNormal(0.3, 0.2)), ae.Combined(ae.emission.Thermal(300.0), 0.4)
relaxations = ae.evaporation.ChargeSettings(sweep_interval=20)  # the second to the fourth are those of a part
simulation = ae.Simulation(tip, seed=2, detector=ae.Detector(100.0, 300.0, "equidistant"), charge_settings=relaxations)
print(simulation.run(80, emissions=flown, progress=False).fingerprint())
"""


def numpy_dispatch():
    """Features of this processor that NumPy chooses functions by."""
    from numpy._core._multiarray_umath import __cpu_dispatch__, __cpu_features__

    return " ".join(name for name in __cpu_dispatch__ if __cpu_features__.get(name))


@pytest.mark.parametrize(
    "variant",
    [
        {},
        pytest.param({"OPENBLAS_CORETYPE": "Nehalem"}, marks=pytest.mark.slow),
        pytest.param({"OPENBLAS_CORETYPE": "Haswell"}, marks=pytest.mark.slow),
        {"NPY_DISABLE_CPU_FEATURES": "all"},
        pytest.param({"GLIBC_TUNABLES": "glibc.cpu.hwcaps=-AVX,-AVX2,-FMA,-FMA4,-AVX512F"}, marks=pytest.mark.slow),
    ],
    ids=lambda variant: "".join(variant) or "as it is",
)
def test_a_run_has_the_same_bits_everywhere(variant):
    if "NPY_DISABLE_CPU_FEATURES" in variant:
        if np.lib.NumpyVersion(np.__version__) < "2.0.0":
            pytest.skip("needs NumPy 2")
        variant = {"NPY_DISABLE_CPU_FEATURES": numpy_dispatch()}
    environment = os.environ | variant | {"PYTHONPATH": str(Path(ae.__file__).parents[1])}
    done = subprocess.run(
        [sys.executable, "-P", "-c", PROGRAM], capture_output=True, text=True, check=True, env=environment
    )
    assert done.stdout.strip() == FINGERPRINT


@pytest.mark.slow
def test_the_run_of_the_readme_has_the_fingerprint_in_the_documentation():
    root = Path(__file__).parents[2]
    config = read_config(root / "examples" / "ni111.toml")
    run = config.simulation().run(config.n_ions, config.emissions, responses=config.responses, progress=False)
    assert run.fingerprint() in (root / "docs" / "architecture.rst").read_text()


def test_fingerprints_tell_runs_apart(small_tip, tmp_path):
    run = ae.Simulation(small_tip, seed=1).run(20, progress=False)
    run.save(tmp_path / "a.h5")
    assert ae.load(tmp_path / "a.h5").fingerprint() == run.fingerprint()
    assert ae.Simulation(small_tip, seed=1).run(19, progress=False).fingerprint() != run.fingerprint()
    run.charges[3] = np.nextafter(run.charges[3], 2.0)
    assert run.fingerprint() != ae.load(tmp_path / "a.h5").fingerprint()
