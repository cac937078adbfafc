"""Measured maps of three metals and those of one law, folded about their poles, beside each other.

python picture.py three_metals.png --W RUNS/W_160_others_1_responses.h5 --Ni RUNS/Ni_160_others_1_responses.h5
    --Al RUNS/Al_160_others_1_responses.h5

The measured maps are the folded densities in measured.npz, made by measured_numbers.py.
"""

import argparse
import warnings

import matplotlib.pyplot as plt
import numpy as np
from judge import METALS, folded, map_of, projection_of
from measured_numbers import measured_fold

import apt_evap as ae

TITLES = {"W": "tungsten [011]", "Ni": "nickel [111]", "Al": "aluminium [111], 47 mm/rad"}


def pair_of(name, path):
    """Folded measured map, and the simulated one."""
    run = ae.load(path)
    scale = float(np.median(run.at_evaporation_field().energy_scales))
    rule = ae.RollUp.of_metal(name, energy_scale=scale)
    part = rule.probability.probabilities(run.emissions[~run.not_flown]).mean()
    orientation = ae.Orientation.from_settings(run.settings["tip"])
    simulated = folded(map_of(run, rule), orientation, projection_of(run), METALS[name])
    return measured_fold(name), simulated, part


def main():
    """Draw the picture."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("picture")
    for name in TITLES:
        parser.add_argument(f"--{name}", required=True, metavar="RUN")
    options = parser.parse_args()
    warnings.simplefilter("ignore", ae.warnings.ResponseWarning)
    figure, axes = plt.subplots(2, 3, figsize=(10.5, 7.2), layout="constrained")
    for column, name in zip(axes.T, TITLES, strict=True):
        measured, simulated, part = pair_of(name, getattr(options, name))
        end = measured.angles[-1]
        text = f"the law of migration: {part:.0%} roll\ncorrelation {simulated.correlation(measured):.2f}"
        for ax, each, title in zip(column, (measured, simulated), (TITLES[name], text), strict=True):
            image = ax.imshow(each.flattened, origin="lower", extent=(-end, end, -end, end), cmap="inferno",
                              vmin=0.4, vmax=1.7)  # fmt: skip
            ax.set_title(title, fontsize="medium")
            ax.set_facecolor("0.88")
        column[1].set_xlabel("angle from the pole [degrees]")
    for ax, word in zip(axes[:, 0], ("measured", "simulated, R = 160 a"), strict=True):
        ax.set_ylabel(f"{word}\nangle from the pole [degrees]")
    figure.colorbar(image, ax=axes, label="density / its mean nearby", extend="both", fraction=0.03)
    figure.savefig(options.picture, dpi=80)


if __name__ == "__main__":
    main()
