"""Pictures of the page "How to find out what a map shows": a map with its answers, and the master patterns.

python pictures.py [RUN.h5]

The map is that of a simulated run, which is read from the file, or made and saved there; a minute of processor time.
"""

import sys
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

import apt_evap as ae

HERE = Path(__file__).parent


def answers(path):
    """The map of a tilted nickel tip, and its first 3,000 ions, which are undecided."""
    if not path.exists():
        nickel = ae.material("Ni")
        size = {"apex_radius": 30 * nickel.a, "shank_length": 30 * nickel.a, "depth": 6 * nickel.a}
        tip = ae.Tip(nickel, axis=(0.30, 0.54, 0.79), rotation=20.0, offset_seed=1, **size)
        ae.Simulation(tip, seed=1).run(15_000).save(path)
    instrument = ae.Instrument(field_of_view=130.0, efficiency=0.8, resolution=0.1)
    emission = ae.RollUp(ae.TruncatedNormal(0.1, 0.1), probability=0.5)
    hits = ae.load(path).at_evaporation_field().record(instrument, emission).within_circle(65.0)
    for name, measured in (("find_orientation", hits.map(bins=64)), ("undecided", hits[:3_000].map(bins=32))):
        found = ae.index(measured, "Ni", scales=(90, 105))
        print(found)
        ae.plot.indexing(found)[0].figure.savefig(HERE / f"{name}.png", dpi=80)


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
    answers(Path(sys.argv[1] if len(sys.argv) > 1 else "tilted.h5"))
    patterns()
