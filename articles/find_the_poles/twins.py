"""Blind twins: maps of large tips with random orientations, indexed without their truth.

    python twins.py RUNS            # five tips with R = 50 a, about 40 minutes of one core, and 40 maps
    python twins.py RUNS --small    # maps of 1,000 to 3,000 ions

The tips are not those of the master patterns: other axes, another radius, another offset of the lattice. The charging
rule and the emissions are the same. Each map has a random tilt of up to 15 degrees, rotation, mirror, scale of 20 to 90
mm/rad, half angle of 15 to 40 degrees, image compression, number of ions, and its centre is up to 5 degrees off. One in
four is of ions that roll up, of ions that do not, unperturbed, and a mixture. Every other map is indexed with a scale
that is known within 10 %.
"""

import argparse
import sys
import time
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

import apt_evap as ae
from apt_evap.maps.crystallography.symmetry import point_group
from apt_evap.maps.indexing.orientation_search import disc_of

sys.path.append(str(Path(__file__).parents[2] / "tools"))
from master_patterns import simulated

TIPS = (("Ni", 11), ("W", 11), ("Si", 11), ("Ni", 12), ("W", 12))  # element and seed
RADIUS, SKIP, IONS, MAPS = 50, 20_000, 90_000, 8
WRONG = {"Ni": "W", "W": "Ni", "Si": "Ni"}


def blind_map(run, number, most):
    """A map, its true projection, and the rotation of the specimen."""
    random = np.random.default_rng(100 + number)
    plain, rolled, still = (run.hits(each) for each in run.perturbations)
    if number % 4 < 3:
        hits = (plain, rolled, still)[number % 4]
        x, y = hits.x, hits.y
    else:
        which = random.random(len(run)) < random.uniform(0.2, 0.8)
        x, y = np.where(which, rolled.x, plain.x), np.where(which, rolled.y, plain.y)
    seen = np.isfinite(x)
    directions = ae.analysis.image_compression(run).projection.directions(np.column_stack([x, y])[seen])
    scale, half_angle = random.uniform(20, 90), random.uniform(15, 40)
    tilt, azimuth, mirror = random.uniform(0, 15), random.uniform(0, 2 * np.pi), random.random() < 0.5
    turn = Rotation.from_rotvec(np.radians(tilt) * np.array([np.cos(azimuth), np.sin(azimuth), 0.0])).as_matrix()
    flat = ae.detection.Projection(scale, mirror=mirror, compression=random.choice([1.5, 2.0, 4.0]))
    places = flat.places(directions[directions[:, 2] > 0] @ turn.T)
    centre = random.uniform(-5, 5, size=2) * scale / 55
    places = places[np.hypot(*places.T) < np.radians(half_angle) * scale]
    n = int(min(len(places), np.exp(random.uniform(np.log(3_000), np.log(60_000))), most))
    places = places[random.permutation(len(places))[:n]] + centre
    map = ae.Hits(x=places[:, 0], y=places[:, 1]).map(bins=128)
    return map, ae.detection.Projection(scale, tuple(centre), mirror, flat.compression), turn, half_angle


def error(map, candidate, projection, matrix, group):
    """Median angle between true and found directions in the inner half of the map [degrees], modulo the symmetry."""
    disc = disc_of(map)
    grid = np.stack(np.meshgrid(*2 * [np.linspace(-0.5, 0.5, 5)]), -1).reshape(-1, 2) * disc.radius + disc.centre
    truth = projection.directions(grid) @ matrix
    found = candidate.projection.directions(grid) @ candidate.orientation.matrix
    return min(np.degrees(np.arccos(np.clip(np.median(((found @ each.T) * truth).sum(1)), -1, 1))) for each in group)


def main():
    """Simulate what is missing, and index."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("runs", type=Path, help="folder of the runs")
    parser.add_argument("--small", action="store_true", help="1,000 to 3,000 ions")
    parser.add_argument("--wrong", action="store_true", help="index as another crystal structure")
    options = parser.parse_args()
    options.runs.mkdir(parents=True, exist_ok=True)
    rows = []
    for element, seed in TIPS:
        path = options.runs / f"{element}_{RADIUS}_{seed}.h5"
        if not path.exists():
            simulated(element, RADIUS, SKIP, IONS, seed).save(path)
        run = ae.load(path)
        orientation = ae.Orientation.from_settings(run.settings["tip"])
        group = point_group(orientation.material.structure)
        for number in range(MAPS):
            most = 1_000 * (1 + number % 3) if options.small else 10**9
            map, projection, turn, half_angle = blind_map(run, number, most)
            known = number % 2 == 0
            bounds = (0.9 * projection.scale, 1.1 * projection.scale) if known else None
            start = time.process_time()
            found = ae.index(map, WRONG[element] if options.wrong else orientation.material, scales=bounds)
            seconds = time.process_time() - start
            matrix = turn @ orientation.matrix
            off = [error(map, each, projection, matrix, group) for each in found.candidates]
            rows.append((found.decided, off[0], min(off), seconds))
            print(
                f"{element} {seed} map {number}: {map.ions:6,} ions, {half_angle:.0f} degrees, scale"
                f" {'known' if known else 'free '} {found.verdict:9} off {off[0]:4.1f}, best candidate {min(off):4.1f},"
                f" {seconds:.1f} s; {found.reason}",
                flush=True,
            )
    decided, off, best, seconds = np.array(rows, float).T
    wrong = np.mean((decided > 0) & (off > 3))
    print(
        f"{len(rows)} maps: first candidate within 2 degrees {np.mean(off < 2):.3f}, one of the candidates"
        f" {np.mean(best < 2):.3f}, decided {decided.mean():.3f}, decided and wrong {wrong:.3f};"
        f" {np.median(seconds):.1f} s, at most {seconds.max():.1f} s of processor time"
    )


if __name__ == "__main__":
    main()
