"""Commands beside the settings of a user."""

import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

import apt_evap as ae


@pytest.mark.slow
def test_a_picture_whatever_the_matplotlibrc(tmp_path):
    """LaTeX, which it asks for, need not be installed: it cannot be found here."""
    random = np.random.default_rng(1)
    x, y = random.normal(size=(2, 500))
    ae.write(tmp_path / "a.epos", ae.Hits(x=x, y=y, mass_to_charge=np.full(500, 28.0), voltage=np.full(500, 5e3)))
    (tmp_path / "matplotlibrc").write_text("text.usetex: True\nsavefig.dpi: 7\n")
    done = subprocess.run(
        [sys.executable, "-m", "apt_evap", "map", "a.epos", "-o", "a.png"],
        cwd=tmp_path,
        capture_output=True,
        text=True,
        env=os.environ | {"PYTHONPATH": str(Path(ae.__file__).parents[1]), "PATH": str(tmp_path)},
    )
    assert done.returncode == 0 and (tmp_path / "a.png").stat().st_size > 10_000, done.stderr[-500:]
