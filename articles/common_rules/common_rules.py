"""Rules of the emission against a measured map with a {111} pole: contrasts, amplitudes and radial densities.

    python articles/common_rules/common_rules.py Ni 80 "0.302 0.540 0.786" MAP.npz --pole -9.6 -0.3 --scale 25.8

The tip has a radius of 80 a and the given axis. The pole of the measured map is at a position [mm], with a scale
[mm/rad]. Every rule is flown for the same ions; for a fraction that rolls up, every ion takes one of
two hits by random numbers. The azimuth between the patterns is the one with the largest correlation for ``--like``:
"all, strongest neighbour" for nickel, "none rolls" for aluminium.
"""

import argparse

import numpy as np

import apt_evap as ae

ENERGY = 0.35  # eV in real units, mean and standard deviation before the truncation
HEIGHT = 0.1  # nm
FRACTIONS = (0.0, 0.05, 0.1, 0.3, 0.4, 0.5, 0.6, 1.0)
RINGS = {"Ni": ((5, 9), (9, 14), (14, 20)), "Al": ((5, 9), (9, 14), (5, 16))}
BINS, HALF = 800, 150.0
MOST_TILTED = 28.0  # degrees: the rings of a pole are inside the map


def launches(scale, sharpness):
    """Perturbations by name; `scale` is the simulated energy per real energy."""
    energy = ae.TruncatedNormal(ENERGY * scale, ENERGY * scale)
    return {
        "unperturbed": ae.Unperturbed(),
        "all, strongest neighbour": ae.RollUp(energy),
        "none rolls": ae.LateralVelocity(energy, HEIGHT),
        "all roll": ae.RollUp(energy, 1.0, sharpness, HEIGHT),
    }


def counts(x, y):
    """Map of the complete detector."""
    edges = np.linspace(-HALF, HALF, BINS + 1)
    there = np.isfinite(x)
    return ae.DetectorMap.from_array(
        np.histogram2d(y[there], x[there], (edges, edges))[0], edges, edges, is_counts=True
    )


def turn(rings, measured):
    """Mirror and shift with the largest correlation."""
    choices = [(mirror, shift) for mirror in (False, True) for shift in range(len(measured[0].profile))]

    def sum_of(choice):
        pairs = zip(rings, measured, strict=True)
        return sum(
            ae.maps.line_amplitude(a, b, mirror=choice[0], shift=choice[1]).value * b.contrast**2 for a, b in pairs
        )

    return max(choices, key=sum_of)


def main():
    """Simulate, and print one line per rule."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("element", choices=RINGS)
    parser.add_argument("radius", type=float, help="in lattice constants")
    parser.add_argument("axis", help="three indices")
    parser.add_argument("measured", help="map with bin edges (.npz)")
    parser.add_argument("--pole", type=float, nargs=2, required=True, help="position of a {111} pole [mm]")
    parser.add_argument("--scale", type=float, required=True, help="mm per radian of crystal angle")
    parser.add_argument("--skip", type=int, default=40_000, help="events before the first ion that flies")
    parser.add_argument("--ions", type=int, default=102_400)
    parser.add_argument("--constant-potential", action="store_true", help="charges; default: Robin's")
    parser.add_argument("--sharpness", type=float, default=0.15, help="of the target of a roll-up")
    parser.add_argument("--like", default="all, strongest neighbour", help="rule that gives the azimuth")
    options = parser.parse_args()
    measured, place = (
        ae.io.read_map(options.measured),
        ae.detection.Projection(options.scale, centre=tuple(options.pole)),
    )
    target = ae.maps.ring_statistics(measured, place, rings=RINGS[options.element], fold=3)
    print(
        "measured", *(f"{ring.contrast:.2f}" for ring in target), ae.maps.pole_profile(measured, place).density.round(2)
    )

    material = ae.material(options.element)
    size = options.radius * material.a
    axis = tuple(float(index) for index in options.axis.split())
    tip = ae.Tip(material, size, axis=axis, shank_length=2 * size, depth=8 * material.a)
    rule = ae.ConstantPotential(law_field="charge") if options.constant_potential else ae.Robin()
    simulation = ae.Simulation(tip, seed=1, rule=rule)
    pilot = simulation.run(256, responses=False, progress=False).at_evaporation_field()
    emissions = launches(float(np.median(pilot.energy_scales)), options.sharpness)
    for _ in simulation.emitter.advance(options.skip):
        pass
    run = simulation.run(options.ions, list(emissions.values()), responses=False)
    hits = {name: run.hits(each) for name, each in emissions.items()}
    projection = ae.simulation.image_compression(run).projection
    poles = ae.Orientation.from_settings(run.settings["tip"]).directions(
        np.array([(a, b, c) for a in (1, -1) for b in (1, -1) for c in (1, -1)]) / np.sqrt(3)
    )
    pole = poles[np.argmax(poles[:, 2])]
    if pole[2] < np.cos(np.radians(MOST_TILTED)):
        parser.error(f"the axis must be within {MOST_TILTED:g} degrees of a {{111}} pole, got {options.axis}")

    def structure(x, y):
        found = counts(x, y)
        rings = ae.maps.ring_statistics(found, projection, pole, RINGS[options.element], fold=3)
        return rings, ae.maps.pole_profile(found, projection, pole).density

    places = {name: (each.x, each.y) for name, each in hits.items()}
    u = np.random.default_rng(3).random(len(run))
    for fraction in FRACTIONS:
        places[f"rules, fraction {fraction:g}"] = tuple(
            np.where(u < fraction, getattr(hits["all roll"], name), getattr(hits["none rolls"], name)) for name in "xy"
        )
    mirror, shift = turn(structure(*places[options.like])[0], target)
    wanted = ae.maps.pole_profile(measured, place).density
    for name, each in places.items():
        rings, radial = structure(*each)
        amplitudes = [
            ae.maps.line_amplitude(a, b, mirror=mirror, shift=shift) for a, b in zip(rings, target, strict=True)
        ]
        print(
            f"{name:26}",
            *(f"{ring.contrast:.2f} ± {ring.error:.2f}" for ring in rings),
            *(f"{each.value:5.1f}" for each in amplitudes),
            radial.round(2),
            f"{np.sqrt(np.mean((radial - wanted) ** 2)):.2f}",
        )


if __name__ == "__main__":
    main()
