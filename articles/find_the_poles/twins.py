"""Blind twins: maps of tips in random orientations, indexed without their truth.

    python twins.py RUNS simulate Pt Ta     # runs of some tips, all by default: half an hour of one core
    python twins.py RUNS index Pt Ta        # eight maps of each; --wrong: as another structure
    python twins.py RUNS index Pt --draw 1 --maps 4 --ions 20000    # other maps, of 20,000 ions or more
    python twins.py RUNS bicrystals Pt --second 0.25 0.5            # two grains in a map, the second 25 to 50 % of it
    python twins.py RUNS structureless --maps 20                    # rings, gradients, stripes, spots
    python twins.py RUNS simulate Cu --long                         # a longer run: no ion is in one of its maps twice
    python twins.py RUNS lenses Cu --maps 10                        # scale and its error, of lenses of -20 to 20 %
    python twins.py RUNS rim Cu --maps 20                           # ten of one grain, ten with 4 to 12 % of another

The tips are not those of the master patterns: other metals or radii, other axes. The ions of a run are folded by the
symmetry of the crystal, so that a map can show any axis: an ion stands at all its equal directions, and is drawn so
that the density is that of the tip. Each map has a random axis, rotation, scale of 20 to 90 mm/rad, half angle of 15 to
40 degrees, image compression, one of five emissions or a mixture of some, 4,000 to 300,000 ions as far as the run has
them, a centre up to 0.08 radii off, an efficiency that changes by up to 30 % to the rim, and up to 12 % of background.
"""

import argparse
import math
import time
from functools import partial
from pathlib import Path

import numpy as np
import scipy
from scipy.spatial.transform import Rotation

import apt_evap as ae
from apt_evap.maps.indexing.orientation_search import disc_of
from apt_evap.specimen.symmetry import point_group

TIPS = {  # radius [a], charging rule, events before the first ion, ions, seed of axis and offset
    "Pt": (24, "constant", 4_000, 14_000, 61),
    "Ag": (50, "Robin", 9_000, 18_000, 62),
    "Ni": (160, "constant", 40_000, 24_000, 63),
    "Ta": (28, "Robin", 3_000, 12_000, 64),
    "Mo": (60, "constant", 9_000, 18_000, 65),
    "Fe": (160, "Robin", 40_000, 24_000, 66),
    "Ge": (22, "Robin", 5_000, 14_000, 67),
    "Si": (60, "constant", 20_000, 20_000, 68),
    "Cu": (40, "constant", 6_000, 80_000, 69),
    "Al": (40, "constant", 6_000, 18_000, 71),
    "W": (40, "Robin", 6_000, 18_000, 72),
    "Au": (30, "Robin", 4_000, 16_000, 73),
    "Nb": (50, "constant", 9_000, 18_000, 74),
    "Ir": (28, "constant", 3_000, 14_000, 75),
    "V": (36, "Robin", 5_000, 16_000, 76),
    "Pd": (70, "Robin", 12_000, 20_000, 77),
}
WRONG = {"fcc": "W", "bcc": "Ni", "diamond": "Ni"}
EMISSIONS = (
    ae.Unperturbed(),
    ae.LateralVelocity(ae.TruncatedNormal(0.35, 0.35), 0.1),
    ae.LateralVelocity(ae.TruncatedNormal(0.1, 0.1), 0.05),
    ae.RollUp(ae.TruncatedNormal(0.35, 0.35), 1.0, 0.4, 0.1),
    ae.RollUp(ae.TruncatedNormal(0.1, 0.1), 1.0, 0.8, 0.1),
)
MIXTURES = ((1, 3), (0, 1, 2), (3, 4), (0, 1, 2, 3, 4), (1, 2, 3, 4))
LENSES = (-0.2, -0.1, 0.0, 0.1, 0.2)
"""Relative displacements of the rim towards the centre."""
CONE = math.radians(52)
"""Largest angle from the axis of a run of the ions that are used."""
LONG = 60_000
"""Ions of a long run."""


def path_of(runs, element, long):
    """File of the run of a tip."""
    return runs / f"{element}_{TIPS[element][0]}{'_long' if long else ''}.h5"


def simulated(element, long):
    """Run of a tip along a random axis."""
    radius, rule, skip, ions, seed = TIPS[element]
    material = ae.material(element)
    size = radius * material.a
    axis = tuple(np.random.default_rng(seed).normal(size=3).tolist())
    depth = (12 if long else 6) * material.a
    tip = ae.Tip(material, size, axis=axis, shank_length=size, depth=depth, offset_seed=seed)
    simulation = ae.Simulation(
        tip,
        seed=seed,
        rule=ae.Robin() if rule == "Robin" else ae.ConstantPotential(),
        detector=ae.Detector(distance=100.0, width=500.0, projection="equidistant"),
        response_settings=ae.ResponseSettings(energy_limit=4.0),
    )
    for _ in simulation.emitter.advance(skip):
        pass
    return simulation.run(LONG if long else ions, progress=False)


class Crystal:
    """Directions of the ions of a run in its crystal, for every emission; maps show them once, or all equal ones."""

    def __init__(self, run, once=False):
        self.once = once
        self.orientation = ae.Orientation.from_settings(run.settings["tip"])
        self.group = point_group(self.orientation.material.structure)
        real = run.at_evaporation_field()
        projection = ae.simulation.image_compression(run).projection
        self.ions = [_flattened(projection, real.hits(emission), self.orientation.matrix) for emission in EMISSIONS]

    def map(self, seed, least=4_000, second=0.0):
        """A map, its projection, the rotation from crystal to specimen, and what it is.

        `least` is its smallest number of ions, `second` the part of its disc that another grain takes.
        """
        random = np.random.default_rng(seed)
        turn = Rotation.random(random_state=int(random.integers(1 << 31))).as_matrix()
        half_angle, scale = math.radians(random.uniform(15, 40)), random.uniform(20, 90)
        kind = int(random.integers(len(EMISSIONS) + len(MIXTURES)))
        kinds = [kind] if kind < len(EMISSIONS) else MIXTURES[kind - len(EMISSIONS)]
        projection = ae.detection.Projection(scale, compression=float(random.choice([1.5, 2.0, 4.0])))
        centre = random.uniform(-0.08, 0.08, 2) * half_angle * scale
        share = random.uniform(0.2, 0.8, len(kinds)) if len(kinds) > 1 else np.ones(1)
        radius = half_angle * scale
        places = self.places(random, turn, kinds, share, projection, half_angle)
        if second:
            other = Rotation.random(random_state=int(random.integers(1 << 31))).as_matrix()
            others = self.places(random, other, kinds, share, projection, half_angle)
            angle, boundary = random.uniform(0, 2 * math.pi), radius * segment(second)
            normal = np.array((math.cos(angle), math.sin(angle)))
            within, beyond = (
                part[((part - centre) @ normal > boundary) == wanted]
                for part, wanted in ((places, False), (others, True))
            )
            places = np.concatenate([within, beyond])
        places = places[np.hypot(*(places - centre).T) < radius]
        efficiency = 1 + (places - centre) / radius @ random.uniform(-0.3, 0.3, 2)
        places = places[random.random(len(places)) < efficiency / 1.5]
        n = int(min(len(places), math.exp(random.uniform(math.log(least), math.log(300_000)))))
        background = int(random.uniform(0, 0.12) * n)
        distance, angle = radius * np.sqrt(random.random(background)), random.uniform(0, 2 * math.pi, background)
        noise = centre + np.column_stack([distance * np.cos(angle), distance * np.sin(angle)])
        places = np.concatenate([places[random.permutation(len(places))[: n - background]], noise])
        detector_map = ae.Hits(x=places[:, 0], y=places[:, 1]).map(bins=128)
        return detector_map, projection, turn, f"emission {kind}, {math.degrees(half_angle):.0f} degrees"

    def through_lens(self, seed, change, least):
        """A map through a lens, of 22 to 36 degrees, its projection, rotation, and what it is.

        An ion stands at one of its equal directions only, so that the noise is not symmetric.
        """
        random = np.random.default_rng(seed)
        turn = Rotation.random(random_state=int(random.integers(1 << 31))).as_matrix()
        half_angle, scale = math.radians(random.uniform(22, 36)), random.uniform(30, 80)
        kind = int(random.integers(len(EMISSIONS) + len(MIXTURES)))
        kinds = [kind] if kind < len(EMISSIONS) else MIXTURES[kind - len(EMISSIONS)]
        share = random.uniform(0.2, 0.8, len(kinds)) if len(kinds) > 1 else np.ones(1)
        lens = ae.detection.Projection(scale, barrel=change / half_angle**2)
        places = self.places_once(random, turn, kinds, share, lens, scale * half_angle * (1 - change))
        n = int(min(len(places), math.exp(random.uniform(math.log(least), math.log(60_000)))))
        places = places[random.permutation(len(places))[:n]]
        detector_map = ae.Hits(x=places[:, 0], y=places[:, 1]).map(bins=128)
        return detector_map, lens, turn, f"emission {kind}, {math.degrees(half_angle):.0f} degrees, lens {change:+.0%}"

    def places(self, random, turn, kinds, share, projection, half_angle):
        """Places of the ions of a crystal with a rotation, with the same density in all directions."""
        if self.once:
            return self.places_once(random, turn, kinds, share, projection, 1.1 * half_angle * projection.scale)
        crystal = self._drawn(random, kinds, share)
        crystal = np.concatenate([crystal @ member.T for member in self.group])
        crystal = crystal[(crystal @ turn.T)[:, 2] > math.cos(min(1.25 * half_angle + 0.1, 1.3))]
        return projection.places(crystal[random.random(len(crystal)) < self._chance(crystal)] @ turn.T)

    def places_once(self, random, turn, kinds, share, projection, radius):
        """The same within a radius [mm], but each ion at one of its places only."""
        crystal = self._drawn(random, kinds, share)
        places = np.stack([projection.places(crystal @ member.T @ turn.T) for member in self.group])
        shown = np.hypot(*np.moveaxis(places, 2, 0)) < radius
        number = shown.sum(axis=0)
        kept = np.flatnonzero(random.random(len(crystal)) < self._chance(crystal) * number / number.max())
        return places[(random.random(shown.shape) * shown).argmax(axis=0)[kept], kept]

    def _drawn(self, random, kinds, share):
        """Directions in the crystal of ions of a mixture of emissions, drawn for the same density at all radii."""
        parts = []
        for (directions, acceptance), part in zip((self.ions[k] for k in kinds), share, strict=True):
            parts.append(directions[random.random(len(directions)) < part * acceptance])
        return np.concatenate(parts)

    def _chance(self, crystal):
        """Chance of directions to be used: where more equal ones are within the cone of the run there are more ions."""
        axis = self.orientation.matrix[2]
        covered = sum((crystal @ member @ axis > math.cos(CONE)).astype(int) for member in self.group)
        return np.minimum(1, np.quantile(covered, 0.2) / np.maximum(covered, 1))

    def error(self, detector_map, candidate, *, projection, turn):
        """Median angle of true and found directions in the inner half [degrees], for the best equal crystal."""
        disc = disc_of(detector_map)
        grid = np.stack(np.meshgrid(*2 * [np.linspace(-0.5, 0.5, 5)]), -1).reshape(-1, 2) * disc.radius + disc.centre
        truth = projection.directions(grid) @ turn
        seen = candidate.projection.directions(grid) @ candidate.orientation.matrix
        cosines = [np.median(((seen @ member.T) * truth).sum(1)) for member in self.group]
        return math.degrees(math.acos(np.clip(max(cosines), -1, 1)))


def _flattened(projection, hits, matrix):
    """Directions in the crystal within the cone, and the chance of each for a density that depends on no radius."""
    places = np.column_stack([hits.x, hits.y])
    directions = projection.directions(places[np.isfinite(places).all(axis=1)])
    angles = np.arccos(np.clip(directions[:, 2], -1, 1))
    directions, angles = directions[angles < CONE], angles[angles < CONE]
    edges = np.linspace(0, CONE, 9)
    density = np.histogram(angles, edges)[0] / (np.cos(edges[:-1]) - np.cos(edges[1:]))
    fit = np.polyfit(((edges[1:] + edges[:-1]) / 2) ** 2, np.log(np.maximum(density, 1)), 2)
    smooth = np.exp(np.polyval(fit, angles**2))
    return directions @ matrix, np.minimum(1, np.quantile(smooth, 0.3) / smooth)


def segment(part):
    """Distance of a chord from the centre of a circle of radius 1 that cuts off a part of it."""
    return scipy.optimize.brentq(lambda d: math.acos(d) - d * math.sqrt(1 - d * d) - math.pi * part, -1, 1)


def structureless(number, least):
    """A map of a disc without a crystal: rings, a gradient, stripes, or spots of hot pixels; and its name."""
    random = np.random.default_rng(9_000 + number)
    what = ("rings", "gradient", "stripes", "spots")[number % 4]
    n = int(math.exp(random.uniform(math.log(least), math.log(300_000))))
    angle, waves, depth = random.uniform(0, 2 * math.pi), random.uniform(1, 8), random.uniform(0.2, 0.9)
    places = random.uniform(-1, 1, (8 * n, 2))
    radius, across = np.hypot(*places.T), places @ (math.cos(angle), math.sin(angle))
    density = {
        "rings": 1 + depth * np.cos(2 * math.pi * waves * radius),
        "gradient": 1 + depth * (across + 0.5 * np.cos(3 * across)),
        "stripes": 1 + depth * np.cos(2 * math.pi * waves * across),
        "spots": np.ones(len(places)),
    }[what]
    places = places[(radius < 1) & (random.random(len(places)) * 2.5 < density)][:n]
    if what == "spots":
        centres = random.uniform(-0.6, 0.6, (int(random.integers(1, 5)), 2))
        hot = centres[random.integers(len(centres), size=n // 50)] + random.normal(0, 0.004, (n // 50, 2))
        places = np.concatenate([places, hot])
    places *= random.uniform(15, 45)
    return ae.Hits(x=places[:, 0], y=places[:, 1]).map(bins=128), what


def indexed(name, detector_map, material, what, errors_of=None):
    """Index a map and print the result, with the errors of its candidates."""
    start = time.process_time()
    try:
        result = ae.index(detector_map, material)
    except ValueError as error:  # a field of view with holes
        print(f"{name}: refused, {error}", flush=True)
        return
    seconds = time.process_time() - start
    errors = [errors_of(item) for item in result.candidates] if errors_of else []
    off = f" off {errors[0]:5.1f}, best candidate {min(errors):5.1f}," if errors else ""
    ions = f"{detector_map.ions:7,} ions"
    print(f"{name}: {ions}, {what}: {result.verdict:9}{off} {seconds:4.1f} s; {result.reason}", flush=True)


def scale_of_lens(name, detector_map, material, what, lens, turn):
    """Deviation of the scale at the centre of the true orientation, and its error, relative to the true scale."""
    found = ae.index(detector_map, material, start=(ae.Orientation.from_matrix(material, turn), lens)).best
    off, error = found.projection.scale / lens.scale - 1, found.scale_error / lens.scale
    rim = f"rim {found.rim_change:+.2f}"
    print(f"{name}: {detector_map.ions:7,} ions, {what}: scale {off:+.1%} ± {error:.1%}, {rim}", flush=True)
    return off, error


def coverage(scales):
    """Print how far scales are off, and how often their errors contain the truth."""
    off, error = np.abs(scales).T
    print(
        f"{len(off)} maps: RMS {np.sqrt((off**2).mean()):.1%}, within 3 % {(off < 0.03).mean():.0%}, median error "
        f"{np.median(error):.1%}, within one error {(off < error).mean():.0%}, two {(off < 2 * error).mean():.0%}"
    )


def main():
    """Simulate, or index."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("runs", type=Path, help="folder of the runs")
    parser.add_argument("what", choices=("simulate", "index", "bicrystals", "structureless", "lenses", "rim"))
    parser.add_argument("elements", nargs="*", metavar="ELEMENT", help=", ".join(TIPS))
    parser.add_argument("--wrong", action="store_true", help="index as another crystal structure")
    parser.add_argument("--maps", type=int, default=8, help="maps of each tip, or without structure")
    parser.add_argument("--ions", type=int, default=4_000, help="fewest ions of a map")
    parser.add_argument("--draw", type=int, default=0, help="other maps of the same tips")
    parser.add_argument("--second", type=float, nargs=2, default=(0.05, 0.5), help="part of the second grain")
    parser.add_argument("--long", action="store_true", help="longer runs, those of `lenses` and `rim`")
    options = parser.parse_args()
    options.runs.mkdir(parents=True, exist_ok=True)
    elements = options.elements or list(TIPS)
    if options.what == "structureless":
        for number in range(options.maps):
            detector_map, what = structureless(number + 100 * options.draw, options.ions)
            element = elements[number % len(elements)]
            indexed(f"{number} as {element}", detector_map, element, what)
        return
    scales = []
    for element in elements:
        once = options.long or options.what in ("lenses", "rim")
        path = path_of(options.runs, element, once)
        if options.what == "simulate":
            if not path.exists():
                simulated(element, options.long).save(path)
            continue
        crystal = Crystal(ae.load(path), once)
        material = crystal.orientation.material
        if options.what == "lenses":
            for number in range(options.maps):
                seed = 10_000 * options.draw + 100 * TIPS[element][4] + 70 + number
                detector_map, lens, turn, what = crystal.through_lens(seed, LENSES[number % 5], options.ions)
                name = f"{element} {TIPS[element][0]} a, map {number}"
                scales.append(scale_of_lens(name, detector_map, material, what, lens, turn))
            continue
        for number in range(options.maps):
            seed, second = 10_000 * options.draw + 100 * TIPS[element][4] + number, 0.0
            if options.what == "bicrystals":
                seed, second = seed + 50, float(np.random.default_rng(seed + 50).uniform(*options.second))
            if options.what == "rim" and 2 * number >= options.maps:
                second = float(np.random.default_rng(seed).uniform(0.04, 0.12))
            detector_map, projection, turn, what = crystal.map(seed, options.ions, second)
            what += f", second grain {second:.2f}" if second else ""
            indexed(
                f"{element} {TIPS[element][0]} a, map {number}",
                detector_map,
                WRONG[material.structure] if options.wrong else material,
                what,
                partial(crystal.error, detector_map, projection=projection, turn=turn),
            )
    if scales:
        coverage(np.array(scales))


if __name__ == "__main__":
    main()
