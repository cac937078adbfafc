"""The verdict on 24 pairs of maps: right and wrong crystals and axes, small and large tips.

    python verdict.py NICKEL.npz ALUMINIUM.npz TUNGSTEN.epos [--known-scale]

Simulated maps are drawn from the master patterns. Nickel and aluminium show a {111} pole of fcc, tungsten a {011} pole
of bcc. One line for each pair: correlation of the registration, verdict, and agreement of the symmetries.
"""

import argparse
import warnings

import numpy as np

import apt_evap as ae

WIDTH, SCALE, ROLLED = 110.0, 60.0, 0.6  # mm, mm/rad, part
SIMULATED = (("Ni", (1, 1, 1)), ("W", (0, 1, 1)), ("Ni", (0, 0, 1)), ("W", (1, 1, 1)))
RIGHT = {"nickel": SIMULATED[0], "aluminium": SIMULATED[0], "tungsten": SIMULATED[1]}
SCALES = {"nickel": 25.8, "aluminium": 52.0, "tungsten": 195.0}  # mm/rad
WITHIN = 0.15


def in_the_measured_frame(simulated, measured, registration):
    """Counts of the simulated map in the bins of the measured one, where both are known."""
    counts = simulated.counts.ravel()
    x, y = (np.repeat(each.ravel(), counts) for each in np.meshgrid(*simulated.centres))
    within = np.random.default_rng(0).uniform(-0.5, 0.5, (2, len(x)))
    x, y = registration.points(*(np.stack([x, y]) + within * np.array(simulated.bin_size)[:, None]))
    values, _, _ = np.histogram2d(y, x, (measured.y_edges, measured.x_edges))
    back = registration.inverse_points(*(each.ravel() for each in np.meshgrid(*measured.centres)))
    inside = (np.hypot(*back) < 0.49 * WIDTH).reshape(values.shape) & measured.mask
    return ae.DetectorMap.from_array(values, measured.x_edges, measured.y_edges, mask=inside, is_counts=True)


def main():
    """Print the verdicts."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("nickel")
    parser.add_argument("aluminium")
    parser.add_argument("tungsten", help="ions")
    parser.add_argument("--known-scale", action="store_true", help=f"within {WITHIN:.0%}%")
    options = parser.parse_args()
    maps = {name: ae.io.read_map(getattr(options, name)) for name in ("nickel", "aluminium")}
    maps["tungsten"] = ae.read(options.tungsten).map(bins=160)
    warnings.simplefilter("ignore", ae.warnings.RegistrationWarning)
    for name, measured in maps.items():
        for element, axis in SIMULATED:
            patterns = ae.maps.master_patterns(ae.material(element).structure)
            patterns = sorted(patterns, key=lambda each: each.apex_radius)
            for pattern, ions in zip(patterns, (15_000, 60_000), strict=True):
                orientation = ae.Orientation(element, axis=axis, rotation=10.0)
                projection = ae.detection.Projection(SCALE)
                simulated = pattern.map(orientation, projection, WIDTH, ions=ions, rolled=ROLLED, seed=1, bins=160)
                ratio = SCALES[name] / SCALE
                scales = (ratio * (1 - WITHIN), ratio * (1 + WITHIN)) if options.known_scale else None
                registration = ae.register(simulated, measured, scales=scales)
                seen = in_the_measured_frame(simulated, measured, registration)
                found = ae.maps.likeness(seen, measured, registration)
                print(
                    f"{name:10} {'right' if RIGHT[name] == (element, axis) else 'wrong'} {element}{axis}"
                    f" R = {pattern.apex_radius:.0f} a: correlation {registration.score:.2f},"
                    f" {found.verdict}, {found.symmetry:.2f}",
                    flush=True,
                )


if __name__ == "__main__":
    main()
