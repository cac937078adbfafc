"""
Field factor and image compression against the radius
=====================================================

Computes the lens of a local electrode for three angles of the shank, draws the figure, and prints the tables of the
README and of the page "The microscope". It takes a minute.
"""

import argparse
import time

import matplotlib.pyplot as plt
import numpy as np

import apt_evap as ae

ANGLES = (2.0, 5.0, 10.0)


def draw(lenses, path):
    """Field factor and compression as functions of the radius."""
    radii = np.geomspace(10.0, 200.0, 60)
    figure, axes = plt.subplots(1, 2, figsize=(9.0, 3.6), layout="constrained")
    for angle, lens in lenses.items():
        axes[0].plot(radii, lens.field_factor(radii), label=f"shank {angle:g}°")
        axes[1].plot(radii, lens.compression(radii), label=f"shank {angle:g}°")
    for ax, title in zip(axes, ("field factor k_f = V / (F R)", "image compression θ / θ'"), strict=True):
        ax.set_xscale("log")
        ax.set_xticks([10, 20, 50, 100, 200], ["10", "20", "50", "100", "200"])
        ax.minorticks_off()
        ax.set_xlabel("radius of the apex [nm]")
        ax.set_title(title)
        ax.grid(alpha=0.3)
    axes[0].legend()
    figure.savefig(path, dpi=150)


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("-o", "--output", default="microscope.png", help="the figure")
    options = parser.parse_args()
    lenses = {angle: ae.detection.LocalElectrode(distance=40e3, aperture=20e3, shank_angle=angle) for angle in ANGLES}
    draw(lenses, options.output)
    radii = np.array([20.0, 40.0, 80.0, 160.0])
    for angle, lens in lenses.items():
        print(f"shank {angle:g}: k_f", lens.field_factor(radii).round(2), "xi", lens.compression(radii).round(3))
        print("  widest angle", [round(lens.widest_angle(radius), 1) for radius in radii])
    base = {"distance": 40e3, "aperture": 20e3, "shank_angle": 5.0}
    for change in (
        {},
        {"distance": 20e3},
        {"distance": 80e3},
        {"aperture": 10e3},
        {"aperture": 40e3},
        {"electrode_angle": 45.0},
        {"electrode_angle": 90.0},
        {"shank_length": 50e3},
        {"shank_length": 500e3},
        {"shank_angle": 6.0},
    ):
        start = time.process_time()
        lens = ae.detection.LocalElectrode(**(base | change)).lens(50.0)
        found = lens.field_factor, lens.compression
        print(change, "k_f {:.3f} xi {:.3f}".format(*found), f"{time.process_time() - start:.2f} s")
    plane = ae.detection.LocalElectrode.preset("plane electrode")
    print("plane electrode", plane.field_factor(50.0), plane.compression(50.0))


if __name__ == "__main__":
    main()
