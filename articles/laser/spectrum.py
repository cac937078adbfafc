"""
The tail of a laser peak
========================

Draws the peak of Si2+ with jitter alone, and with the cooling of the specimen, beside a measured peak if there is one,
and prints the shares of the ions beyond the front of the peak.

    python spectrum.py --measured specimen.epos
"""

import argparse

import matplotlib.pyplot as plt
import numpy as np

import apt_evap as ae

MASS, CHARGE = 27.9769, 2  # Da of the isotope 28, e
VOLTAGE, LENGTH = 5000.0, 100.0  # V, mm: typical, as the file has none
WINDOW = (13.95, 14.35)  # Da, without the next isotope
BEYOND = (0.02, 0.04, 0.06, 0.1)  # Da after the maximum


def peak(timing, count, seed):
    """m/n of ions with these errors of their times [Da], as the instrument calculates it."""
    time = LENGTH / np.sqrt(ae.detection.timing.MASS_TO_CHARGE * VOLTAGE / (MASS / CHARGE))
    _, delays = timing.errors(np.random.default_rng(seed).random((count, 2)))
    return MASS / CHARGE * (1 + delays / time) ** 2


def aligned(masses, edges):
    """Counts about the maximum, which is at 0."""
    counts, fine = np.histogram(masses, np.arange(*WINDOW, 0.004))
    return np.histogram(masses - (fine[counts.argmax()] + 0.002), edges)[0]


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--measured", help="ions with a peak of Si2+")
    parser.add_argument("-o", "--output", default="spectrum.png")
    options = parser.parse_args()
    edges = np.arange(-0.06, 0.3, 0.005)
    middles = (edges[1:] + edges[:-1]) / 2
    base = {"temperature": 50.0, "temperature_rise": 150.0}
    curves = {
        "jitter of 0.06 ns": ae.detection.Timing(0.06),
        "and cooling, exponential, 1.8 ns": ae.detection.Timing(
            0.06, cooling=ae.detection.Cooling(**base, time_constant=1.8)
        ),
        "and cooling by conduction, 0.6 ns": ae.detection.Timing(
            0.06, cooling=ae.detection.Cooling(**base, time_constant=0.6, decay="conduction")
        ),
    }
    found = {name: aligned(peak(timing, 2_000_000, 1), edges) for name, timing in curves.items()}
    if options.measured:
        masses = ae.read(options.measured).mass_to_charge
        masses = masses[(masses > WINDOW[0]) & (masses < WINDOW[1])]
        counts = aligned(masses, edges)
        background = np.median(counts[(middles > 0.2) & (middles < 0.28)])
        print(f"measured: {len(masses):,} ions, background {background:g} in {edges[1] - edges[0]:.3f} Da")
        found = {"measured": np.maximum(counts - background, 0)} | found
    figure, ax = plt.subplots(figsize=(7.0, 4.2), layout="constrained")
    for name, counts in found.items():
        kept = counts * (middles < 0.2)
        shares = [kept[middles > each].sum() / kept.sum() for each in BEYOND]
        half = (kept > kept.max() / 2).sum() * (edges[1] - edges[0])
        tenth, hundredth = ((kept > kept.max() / k).sum() * (edges[1] - edges[0]) for k in (10, 100))
        texts = ", ".join(f"{100 * share:.2f} % beyond +{each:g}" for share, each in zip(shares, BEYOND, strict=True))
        print(f"{name}: widths {half:.3f}, {tenth:.3f}, {hundredth:.3f} Da at 1/2, 1/10, 1/100; {texts}")
        style = {"color": "black", "linewidth": 2.0} if name == "measured" else {}
        ax.step(middles, kept / kept.max(), where="mid", label=name, **style)
    ax.set(yscale="log", ylim=(1e-5, 2), xlim=(-0.05, 0.2), ylabel="ions, relative to the maximum")
    ax.set_xlabel("m/n from the maximum of the peak of Si$^{2+}$ [Da]")
    ax.legend()
    ax.grid(alpha=0.3)
    figure.savefig(options.output, dpi=150)


if __name__ == "__main__":
    main()
