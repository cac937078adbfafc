"""Measured maps of tungsten and nickel beside those of four rules, folded about their poles.

    python picture.py hop_energy.png --W RUNS/W_160.h5 RUNS/W_80_hops.npz
        --Ni RUNS/Ni_160.h5 RUNS/Ni_80_hops.npz

The measured maps are the folded densities in `../three_metals/measured.npz`, made by `measured_numbers.py` there.
"""

import argparse
import warnings
from dataclasses import replace

import matplotlib.pyplot as plt
import numpy as np
from energies import METALS, ByGain, amplitude, folded, gain_line, map_of, measured_fold, projection_of, rings

import apt_evap as ae

PART = 0.035
"""Part of the gain along the surface."""
TITLES = {"W": "tungsten [011]", "Ni": "nickel [111]"}


def rules_of(metal, hops, scale):
    """Emissions by name."""
    rule = ae.RollUp.of_metal(metal, energy_scale=scale)
    mean = 0.12 * rule.probability.polarization * scale
    return {
        "the rule of the metal": rule,
        f"{PART:g} G along the surface": ByGain(metal, gain_line(metal, hops), PART, scale),
        "sharpness 0.1, half its energy": replace(rule, sharpness=0.1, energy=ae.TruncatedNormal(mean, mean)),
        "none rolls (F(T) at 150 K)": ae.LateralVelocity(rule.others),
    }


def main():
    """Draw the picture."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("picture")
    for metal in TITLES:
        parser.add_argument(f"--{metal}", required=True, nargs=2, metavar=("RUN", "HOPS"))
    options = parser.parse_args()
    warnings.simplefilter("ignore", ae.warnings.ResponseWarning)
    figure, axes = plt.subplots(5, 2, figsize=(7.6, 16.5), layout="constrained", sharex="col", sharey="col")
    for column, (metal, title) in zip(axes.T, TITLES.items(), strict=True):
        path, hops = getattr(options, metal)
        run, measured = ae.load(path), measured_fold(metal)
        orientation, projection = ae.Orientation.from_settings(run.settings["tip"]), projection_of(run)
        scale = float(np.median(run.at_evaporation_field().energy_scales))
        panels = {f"{title}, measured": measured}
        for name, rule in rules_of(metal, hops, scale).items():
            fold = folded(map_of(run, rule), orientation, projection, METALS[metal])
            pairs = zip(rings(fold, METALS[metal]), rings(measured, METALS[metal]), strict=True)
            numbers = " ".join(f"{amplitude(*pair):.2f}" for pair in pairs)
            panels[f"{name}\ncorrelation {fold.correlation(measured):.2f}; {numbers}"] = fold
        end = measured.angles[-1]
        for ax, (text, fold) in zip(column, panels.items(), strict=True):
            extent = (-end, end, -end, end)
            image = ax.imshow(fold.flattened, origin="lower", extent=extent, cmap="inferno", vmin=0.4, vmax=1.7)
            ax.set_title(text, fontsize="medium")
            ax.set_facecolor("0.88")
        column[-1].set_xlabel("angle from the pole [degrees]")
    for ax in axes[:, 0]:
        ax.set_ylabel("angle from the pole [degrees]")
    bar = {"extend": "both", "location": "bottom", "fraction": 0.02, "aspect": 40}
    figure.colorbar(image, ax=axes, label="density / its mean nearby", **bar)
    figure.savefig(options.picture, dpi=85)


if __name__ == "__main__":
    main()
