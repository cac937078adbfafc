"""Score of the baseline on the data set "find the poles": `apt_evap.index` on the test maps.

    apt-evap dataset study.toml -o set --workers 2
    python score.py set > score.txt

A line for every map: structure, emission, ions, verdict, largest error of a direction at three
places of the map [degrees], and the poles found: true poles on the map that have a pole of the same family within 2
degrees. At the end the table of the README.
"""

import argparse
import time

import numpy as np

import apt_evap as ae
from apt_evap.specimen.symmetry import point_group

NEAR = 2.0  # degrees
PLACES = np.array([[0.0, 0.0], [15.0, 0.0], [-10.0, 12.0]])  # mm


def error(candidate, truth, places, group):
    """Largest angle between true and found directions [degrees], for the best of the equal crystals."""
    found = candidate.projection.directions(places) @ candidate.orientation.matrix
    return min(np.degrees(np.arccos(np.clip((found @ each.T * truth).sum(axis=1), -1, 1))).max() for each in group)


def family_of(plane):
    """Indices without signs and order; for four indices the last one stays."""
    indices = np.abs(plane).tolist()
    return tuple(sorted(indices)) if len(indices) == 3 else (*sorted(indices[:3]), indices[3])


def poles_found(candidate, planes, places):
    """Number of true poles with a pole of their family within `NEAR`."""
    known = ae.maps.poles(candidate.orientation, 6)
    predicted = candidate.projection.places(candidate.orientation.directions(known.normals))
    families = [family_of(each) for each in known.planes]
    found = 0
    for plane, place in zip(planes, places, strict=True):
        same = [each == family_of(four(plane) if len(known.planes[0]) == 4 else plane) for each in families]
        distance = np.linalg.norm(predicted[same] - place, axis=1)
        found += bool((distance < np.radians(NEAR) * candidate.projection.scale).any())
    return found


def four(plane):
    """Miller-Bravais indices of a plane with three indices."""
    h, k, last = plane
    return (h, k, -h - k, last)


def main():
    """Index all maps of the test split."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("set", help="folder of the data set")
    parser.add_argument("--prior", type=float, metavar="PART", help="the scale is known within this part, such as 0.1")
    parser.add_argument("--wrong", action="store_true", help="index as another crystal structure, as a control")
    parser.add_argument("--split", default="test")
    options = parser.parse_args()
    wrong = {"Ni": "W", "W": "Ni", "Si": "Ni", "Ti": "W"}
    rows = []
    data = ae.load_dataset(options.set).split(options.split)
    for number in range(len(data)):
        example = data[number]
        about = example.about
        if not np.isfinite(about["compression"]):
            continue  # a run with too few ions for an image compression: the poles are not known
        element = wrong[about["material"]] if options.wrong else about["material"]
        detector = ae.detection.Projection(
            about["instrument"]["distance"],
            compression=1.0 if about["instrument"]["projection"] == "plane" else None,
        )
        projection = detector.compressed(about["compression"])
        map = example.hits.map(bins=128, extent=(-40, 40, -40, 40))
        bounds = None if options.prior is None else projection.scale * np.array([1 - options.prior, 1 + options.prior])
        start = time.perf_counter()
        found = ae.index(map, element, scales=bounds)
        seconds = time.perf_counter() - start
        group = point_group(about["structure"])
        truth = projection.directions(PLACES) @ np.asarray(about["orientation"])
        off = error(found.best, truth, PLACES, group)
        shown = np.asarray(example.poles["visible"])
        places = np.column_stack([example.poles["x"], example.poles["y"]])[shown]
        right = 0 if options.wrong else poles_found(found.best, example.poles["indices"][shown], places)
        name = about["emission"]["name"]
        if "probability" in about["emission"]:
            name += " of a part"
        rows.append((about["structure"], name, len(example.hits), found.decided, off, right, len(places), seconds))
        print(*rows[-1][:3], found.verdict, f"off {off:.1f} poles {right}/{len(places)}",
              f"score {found.best.score:.2f} {seconds:.1f} s", flush=True)  # fmt: skip
    if not options.wrong:
        table(rows)
    decided = [row for row in rows if row[3]]
    print(
        f"{len(rows)} maps, {len(decided)} decided, {sum(row[4] > 3 for row in decided)} of them wrong;"
        f" {np.median([row[-1] for row in rows]):.1f} s for one map"
    )


def table(rows):
    """Shares by structure, emission and number of ions."""
    print(f"\n{'':32} {'maps':>5} {'within 2':>9} {'decided':>8} {'decided, wrong':>15} {'poles found':>12}")
    groups = {f"{name}": [row for row in rows if row[0] == name] for name in sorted({row[0] for row in rows})}
    groups |= {name: [row for row in rows if row[1] == name] for name in sorted({row[1] for row in rows})}
    for low, high in ((0, 1500), (1500, 3000), (3000, 6000)):
        groups[f"{low} to {high} ions"] = [row for row in rows if low <= row[2] < high]
    for name, each in (groups | {"all": rows}).items():
        if each:
            near = np.mean([row[4] < 2 for row in each])
            decided = np.mean([row[3] for row in each])
            bad = np.mean([row[3] and row[4] > 3 for row in each])
            poles = sum(row[5] for row in each) / max(1, sum(row[6] for row in each))
            print(f"{name:32} {len(each):5} {near:9.2f} {decided:8.2f} {bad:15.3f} {poles:12.2f}")


if __name__ == "__main__":
    main()
