"""
A run whose radius doubles
==========================

Evaporates a nickel tip on a shank of 8 degrees, puts it behind a local electrode, and compares its voltage curve with
that of the geometry alone. Reconstructs its ions with the lens and with constants, and prints the errors against the
true sites, and the angle of the shank from the voltages.

    python course.py --ions 1000000 --run course.h5
"""

import argparse
import math
from dataclasses import replace
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np

import apt_evap as ae

RADIUS, SHANK, FIELD = 5.6, 8.0, 35.0  # nm, degrees, V/nm
DETECTOR = ae.Detector(distance=90.0, width=80.0)
RIM = 38.0  # mm


def simulate(ions, path):
    """The run, from its file, or that of an unfinished run."""
    for known in (path, Path(f"{path}.unfinished")):
        if known.exists():
            return ae.load(known)
    nickel = ae.material("Ni")
    tip = ae.Tip(
        nickel, RADIUS, axis=(1, 1, 1), shank_angle=SHANK, shank_length=90.0, depth=3.0, offset_seed=1, base="flat"
    )
    run = ae.Simulation(tip, seed=1).run(ions, [ae.Unperturbed()], responses=False, checkpoint=path)
    run.save(path)
    return run


def radius_of(removed, volume):
    """Radius of a cap that touches the shank, after this number of atoms [nm]."""
    sine, cosine = math.sin(math.radians(SHANK)), math.cos(math.radians(SHANK))
    cone = math.pi * cosine**2 * cosine**2 / sine / 3
    cap = math.pi * (1 - sine) ** 2 * (2 + sine) / 3
    return np.cbrt(RADIUS**3 + removed * volume / (cone - cap))


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--ions", type=int, default=1_000_000)
    parser.add_argument("--run", type=Path, default=Path("course.h5"))
    parser.add_argument("-o", "--output", default="course.png")
    options = parser.parse_args()
    run = simulate(options.ions, options.run)
    lens = ae.detection.LocalElectrode.preset("local electrode", shank_angle=SHANK)
    real = run.at_evaporation_field(lens).on_detector(DETECTOR)
    volume = ae.material("Ni").a ** 3 / 4
    at = np.linspace(0, len(run) - 1, 400).astype(int)
    expected = radius_of(at, volume)
    factor = float(np.median(np.interp(at, run.cap.ions, run.cap.radii)[200:] / expected[200:]))
    print(
        f"{len(run):,} ions, R of the cap {run.cap.radii[:5].mean():.2f} to {run.cap.radii[-5:].mean():.2f} nm; "
        f"of the geometry {expected[0]:.2f} to {expected[-1]:.2f} nm, ratio {factor:.3f}"
    )
    model = lens.field_factor(factor * expected) * FIELD * factor * expected
    deviation = real.instrument_voltages[at] / model - 1
    late = at > len(run) // 10
    print(
        f"voltages {real.instrument_voltages[0]:.0f} to {real.instrument_voltages[-1]:.0f} V; "
        f"against the geometry {np.sqrt(np.mean(deviation[late] ** 2)):.2%} RMS after the first tenth"
    )
    hits = real.hits(ae.Unperturbed())
    known = {"atomic_volume": volume, "distance": DETECTOR.distance, "detector_radius": RIM, "evaporation_field": FIELD}
    radii = real.lens.radii(np.arange(len(run)))
    cases = {"lens": {"lens": lens}}
    for name, radius in (("first", radii[0]), ("middle", radii[len(run) // 2]), ("last", radii[-1])):
        constants = {"field_factor": lens.field_factor(radius), "compression": lens.compression(radius)}
        cases[f"constants of the {name} ion, {radius:.1f} nm"] = {**constants, "projection": "compressed"}
    for name, case in cases.items():
        found = ae.reconstruct(hits, **known, **case, smoothing=500)
        errors = found.errors(fit=("shift", "rotation"))
        sites = found.hits.positions
        depth = np.ptp(found.depths) / np.ptp(np.interp(found.hits.ion, run.cap.ions, run.cap.apexes))
        wide = [
            np.hypot(*found.positions[part, :2].T).mean() / np.hypot(*sites[part, :2].T).mean() - 1
            for part in (slice(20_000), slice(-20_000, None))
        ]
        print(
            f"{name}: {len(found):,} ions; RMS {errors.lateral_rms:.3f} nm lateral, {errors.depth_rms:.3f} nm deep; "
            f"depth {depth - 1:+.1%}, width {wide[0]:+.1%} (first) {wide[1]:+.1%} (last)",
            flush=True,
        )
    start = replace(lens, shank_angle=5.0)
    print(ae.reconstruction.fit_shank(hits, start, **known, smoothing=500))
    found = ae.reconstruct(hits, **known, lens=lens, smoothing=500)
    for check in ae.reconstruction.checks(found, {"111": ((0.0, 0.0), ae.material("Ni").a / math.sqrt(3))}):
        print(check)
    figure, ax = plt.subplots(figsize=(7.0, 4.2), layout="constrained")
    ax.plot(at / 1e3, real.instrument_voltages[at], label="run behind the lens")
    ax.plot(at / 1e3, model, "--", color="black", label=f"$k_f(R)\\,F\\,R$ of a cap on a shank of {SHANK:g}°")
    constant = lens.field_factor(expected[0]) * FIELD * factor * expected
    ax.plot(at / 1e3, constant, ":", color="gray", label="the same with $k_f$ of the first ion")
    ax.set(xlabel="thousand ions", ylabel="voltage [V]")
    ax.legend()
    ax.grid(alpha=0.3)
    figure.savefig(options.output, dpi=150)


if __name__ == "__main__":
    main()
