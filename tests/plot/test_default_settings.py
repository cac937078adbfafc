"""Pictures are drawn with the default settings of matplotlib, whatever the matplotlibrc of the user."""

import os
import subprocess
import sys

import matplotlib
import pytest

import apt_evap as ae

DRAW = """
import numpy as np
import apt_evap as ae
random = np.random.default_rng(0)
x, y = random.normal(size=(2, 500))
mass = np.repeat([14.0, 28.0], 250) * random.normal(1, 1e-3, 500)
ions = ae.Hits(x=x, y=y, mass_to_charge=mass, voltage=np.linspace(4e3, 5e3, 500))
cloud = ae.measures.PointCloud(random.random((500, 3)), random.integers(0, 2, 500), ["Al", "Cu"])
figures = {
    "map": lambda: ae.plot.detector_map(ions.map(bins=20)),
    "spectrum": lambda: ae.plot.spectrum(ae.spectrum(ions, "Si")),
    "composition": lambda: ae.plot.composition_profile(cloud.profile(), "Cu"),
    "voltage": lambda: ae.plot.voltage_curve(ions),
}
for name, draw in figures.items():
    figure = np.ravel(draw())[0].figure
    figure.savefig(f"{name}.png", bbox_inches="tight")
    assert figure.get_facecolor() == (1, 1, 1, 1)
"""


@pytest.mark.slow
def test_the_matplotlibrc_of_the_user_changes_no_picture(tmp_path):
    """LaTeX, which may not be installed, ticks that are made when the figure is saved, and its resolution."""
    rc = "text.usetex: True\nfigure.facecolor: red\nsavefig.dpi: 20\nxtick.color: red\naxes.grid: True\n"
    pictures = []
    for content in ("", rc):
        (tmp_path / "matplotlibrc").write_text(content)  # of the working folder
        environment = {**os.environ, "MPLBACKEND": "agg"}
        environment.pop("MATPLOTLIBRC", None)
        subprocess.run([sys.executable, "-c", DRAW], cwd=tmp_path, env=environment, check=True)
        pictures.append({path.name: path.read_bytes() for path in tmp_path.glob("*.png")})
    assert len(pictures[0]) == 4 and pictures[0] == pictures[1]


def test_what_a_program_sets_stays():
    with matplotlib.rc_context({"axes.facecolor": "green"}):
        assert ae.plot.new_figure((2.0, 2.0)).subplots().get_facecolor() == matplotlib.colors.to_rgba("green")
