"""Pictures of the page "How to find out what a map shows": a map with its answer, and the master patterns.

python pictures.py
"""

from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

import apt_evap as ae

HERE = Path(__file__).parent


def answer():
    """A map of nickel, and its indexing."""
    truth = ae.Orientation("Ni", axis=(0.30, 0.54, 0.79), rotation=20.0)
    pattern = ae.maps.master_patterns("fcc")[1]
    measured = pattern.map(truth, ae.detection.Projection(60.0), width=80.0, ions=80_000, rolled=0.4)
    ae.plot.indexing(ae.index(measured, "Ni"))[0].figure.savefig(HERE / "find_orientation.png", dpi=110)


def patterns():
    """Hemispheres about [001], R = 80 a."""
    figure = Figure((10.4, 5.6), layout="constrained")
    rows = figure.subplots(2, 4)
    steps = np.linspace(-1, 1, 501)
    x, y = np.meshgrid(steps, steps)
    r2 = x**2 + y**2  # stereographic
    directions = np.column_stack([(2 * x).ravel(), (2 * y).ravel(), (1 - r2).ravel()])
    names = {"fcc": "fcc (Ni)", "bcc": "bcc (W)", "diamond": "diamond (Si)", "hcp": "hcp (Ti)"}
    for column, (structure, name) in enumerate(names.items()):
        pattern = ae.maps.master_patterns(structure)[-1]
        for row, values in enumerate(pattern.at(directions, sigma=0.4)):
            ax = rows[row, column]
            image = ax.imshow(
                np.where(r2 < 1, values.reshape(x.shape), np.nan),
                origin="lower", cmap="inferno", vmin=0, vmax=2, extent=(-1, 1, -1, 1),
            )  # fmt: skip
            ax.set_axis_off()
            ax.set_title(f"{name}, {'no ion rolls up' if row == 0 else 'all ions roll up'}", fontsize="small")
    figure.colorbar(image, ax=rows, label="hits per solid angle / mean", shrink=0.7, extend="max")
    figure.savefig(HERE / "master_patterns.png", dpi=110)


if __name__ == "__main__":
    answer()
    patterns()
