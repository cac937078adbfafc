"""
Corrections of measured precipitates, with their errors
=======================================================

Specimens of aluminium with one particle of copper each, of random size, content, place and evaporation field. The same
measures are taken of all sites and of what an instrument with an efficiency of one half shows. The even specimens give
the correction, `reconstruction.corrected`; the odd ones judge it. ``corrections.py run FIRST LAST`` simulates, 20 s
of processor time each, and writes ``NUMBER.json``; ``python corrections.py table`` prints the table.
"""

import json
import sys
import warnings
from pathlib import Path

import numpy as np

import apt_evap as ae

A = ae.material("Al").a
R = 16 * A  # nm
FIELD = 19.0  # V/nm, of the matrix
IONS = 12_000
RATIOS = 0.92, 1.12  # of the fields; the others, WIDE, test a correction that is used for another kind of particle
WIDE = 0.8, 0.88
MEASURES = {
    "radius": "radius of the largest cluster [nm]",
    "Cu": "copper of its atoms, with an envelope of 0.5 nm",
    "clustered": "part of the copper that is in clusters",
}
INSTRUMENT = ae.Instrument(distance=90.0, field_of_view=110.0, efficiency=0.5)
WAYS = {"cap": {}, "evolving": {"shape": "evolving", "solutes": ["Cu"]}}


def specimen(number):
    """Run of a specimen; from number 1000 on, the field of the particle is another one."""
    random = np.random.default_rng((20, number))
    radius, content = random.uniform(0.8, 1.8), random.uniform(0.3, 0.6)
    ratio = random.uniform(*(RATIOS if number < 1000 else WIDE))
    away, azimuth = random.uniform(0, 1.2), random.uniform(0, 2 * np.pi)
    place = away * np.cos(azimuth), away * np.sin(azimuth), R - 0.6 - radius - random.uniform(0, 0.4)
    matrix = ae.specimen.Phase("matrix", "Al", solutes={"Cu": 0.01}, evaporation_field=FIELD)
    region = ae.specimen.Sphere(place, radius)
    particle = ae.specimen.Phase("particle", "Al", region, solutes={"Cu": content}, evaporation_field=ratio * FIELD)
    tip = ae.Tip(phases=[matrix, particle], apex_radius=R, axis=(0, 0, 1), shank_length=R, seed=number)
    run = ae.Simulation(tip, seed=number).run(IONS, [ae.Unperturbed()], responses=False, progress=False)
    return {"radius": radius, "content": content, "ratio": ratio}, run


def measure(cloud):
    """Measures of the largest cluster, NaN without one; d_max and n_min are those of the point cloud."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        clusters = cloud.clusters("Cu", envelope=0.5)
    if not len(clusters):
        return dict.fromkeys(MEASURES, np.nan)
    largest = int(np.argmax(clusters.sizes))
    atoms = dict(zip(cloud.elements, clusters.atoms[largest], strict=True))
    return {
        "radius": float(clusters.radii[largest]),
        "Cu": float(atoms["Cu"] / sum(atoms.values())),  # of all ions after envelope and erosion
        "clustered": clusters.clustered_fraction,
    }


def simulate(first, last):
    for number in range(first, last):
        path = Path(f"{number}.json")
        if path.exists():
            continue
        made, run = specimen(number)
        compared = ae.reconstruction.compare_with_truth(run, measure, INSTRUMENT, reconstructions=WAYS, seed=number)
        path.write_text(json.dumps(made | compared.to_dict(), indent=1) + "\n")
        print(number, made, compared.table(), sep="\n", flush=True)


def comparison(number):
    """What a specimen was made with, and its comparison."""
    content = json.loads(Path(f"{number}.json").read_text())
    return content, ae.reconstruction.TruthComparison.from_dict(content)


def table():
    """Of the judged specimens: errors before and after the correction, and how often its intervals hold the truth."""
    numbers = sorted(int(path.stem) for path in Path().glob("*.json"))
    usual = {number: comparison(number)[1] for number in numbers if number < 1000}
    others = [comparison(number)[1] for number in numbers if number >= 1000]
    halves = [[one for number, one in usual.items() if number % 2 == half] for half in (0, 1)]
    print(f"{len(halves[0])} specimens give the correction, {len(halves[1])} judge it, {len(others)} of another field")
    print("measure, way, judged | no value | outside | RMS before | after | error | 68 % hold | 95 % hold")
    for measure in MEASURES:
        for way in WAYS:
            for name, judged in (("same kind", halves[1]), ("other field", others)):
                print(measure, way, name, *row(halves[0], judged, measure, way), sep=" | ")


def row(given, judged, measure, way):
    """Numbers of one line of the table."""
    known = [one for one in given if np.isfinite(one.values[measure][way].value)]
    missing = outside = 0
    before, after, errors = [], [], []
    for one in judged:
        seen, true = one.values[measure][way].value, one.values[measure]["all sites"].value
        if not np.isfinite(seen) or not np.isfinite(true):
            missing += 1
            continue
        try:
            value, error = ae.reconstruction.corrected(known, measure, seen, way)
        except ValueError:  # outside what the simulations show
            outside += 1
            continue
        before.append(seen - true)
        after.append(value - true)
        errors.append(error)
    if not before:
        return [missing, outside]
    hold = [np.mean(np.abs(after) <= scale * np.array(errors)) for scale in (1, 2)]
    rms = [np.sqrt(np.mean(np.square(part))) for part in (before, after)]
    return [missing, outside, *(f"{x:.3f}" for x in (*rms, np.mean(errors))), *(f"{x:.0%}" for x in hold)]


if __name__ == "__main__":
    if sys.argv[1] == "run":
        simulate(int(sys.argv[2]), int(sys.argv[3]))
    else:
        table()
