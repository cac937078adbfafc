"""Pictures are drawn with the default settings of matplotlib, whatever the matplotlibrc of the user."""

import os
import subprocess
import sys

import matplotlib

import apt_evap as ae

DRAW = """
import sys
import numpy as np
import apt_evap as ae
random = np.random.default_rng(0)
axes = ae.plot.detector_map(ae.Hits(x=random.normal(size=500), y=random.normal(size=500)).map(bins=20))
axes.figure.savefig("a.png", bbox_inches="tight")
assert axes.figure.get_facecolor() == (1, 1, 1, 1)
"""


def test_the_matplotlibrc_of_the_user_changes_no_picture(tmp_path):
    """LaTeX, which may not be installed, ticks that are made when the figure is saved, and its resolution."""
    rc = "text.usetex: True\nfigure.facecolor: red\nsavefig.dpi: 20\nxtick.color: red\naxes.grid: True\n"
    pictures = []
    for content in ("", rc):
        (tmp_path / "matplotlibrc").write_text(content)  # of the working folder
        environment = {**os.environ, "MPLBACKEND": "agg"}
        environment.pop("MATPLOTLIBRC", None)
        subprocess.run([sys.executable, "-c", DRAW], cwd=tmp_path, env=environment, check=True)
        pictures.append((tmp_path / "a.png").read_bytes())
    assert pictures[0] == pictures[1]


def test_what_a_program_sets_stays():
    with matplotlib.rc_context({"axes.facecolor": "green"}):
        assert ae.plot.new_figure((2.0, 2.0)).subplots().get_facecolor() == matplotlib.colors.to_rgba("green")
