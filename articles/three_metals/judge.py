"""Runs of `runs.py` against a measured map: folded correlation, place of the lines, rings, densities.

    python judge.py W W3.epos RUNS/W_160_others_1.h5

Both maps are sampled about the same pole, at equal directions of the crystal, and folded by its symmetry. The measured
directions are those of the indexing; the simulated ones have the image compression of the unperturbed ions. The
correlation is that of flattened densities, smoothed by 0.6 degrees. A line of the table: correlation, azimuth of the
bright line in ranges of the angle, amplitudes and contrasts of three rings, densities from the pole outwards.
"""

import argparse
from itertools import pairwise
from pathlib import Path
from typing import NamedTuple

import numpy as np
from runs import EMISSIONS
from scipy.ndimage import gaussian_filter

import apt_evap as ae

STEP = 0.25  # degrees
SMOOTHING, BROAD = 0.6, 6.0  # degrees
_COVERED = 0.9  # part of the weights of the smoothing that is inside the map
FRACTIONS = (0.0, 0.05, 0.2, 0.4, 0.5, 0.6, 0.7, 0.8, 0.9, 1.0)


class Metal(NamedTuple):
    """How a measured map is compared."""

    pole: tuple[int, int, int]
    first: tuple[int, int, int]
    """Direction of azimuth 0."""
    reach: float
    """Largest angle from the pole [degrees]."""
    rings: tuple[tuple[float, float], ...]
    line: tuple[tuple[float, float], ...]
    """Ranges of the angle in which the azimuth of the bright line is measured [degrees]."""


METALS = {
    "W": Metal((0, 1, 1), (1, 0, 0), 15.5, ((4, 7), (7, 11), (11, 15.5)),
               ((5.1, 7.0), (7.0, 9.5), (9.5, 12.7), (12.7, 15.5))),
    "Ni": Metal((1, 1, 1), (-1, -1, 2), 18.0, ((5, 9), (9, 14), (14, 18)), ()),
}  # fmt: skip


def measured_of(metal, path):
    """Measured map, its orientation and projection, and maps of two random halves of its ions, if there are ions."""
    if metal == "Ni":
        # three named poles; without them the map is undecided
        orientation = ae.Orientation("Ni", axis=(0.2926, 0.5418, 0.7879), rotation=155.31)
        return ae.read_map(path), orientation, ae.detection.Projection(26.1013, centre=(0.4029, -0.3919)), None
    ions = ae.read(path)
    map = ions.map(bins=256)
    found = ae.index(map, metal, distance=305.0)
    print(found)
    half = np.random.default_rng(1).random(len(ions)) < 0.5
    halves = [ions[each].map(like=map) for each in (half, ~half)]
    return map, found.best.orientation, found.best.projection, halves


def grid(metal):
    """Directions in the crystal about the pole, shape (n, n, 3), angles and azimuths [degrees]."""
    n = int(np.ceil(metal.reach / STEP))
    u, v = np.meshgrid(np.arange(-n, n + 1) * STEP, np.arange(-n, n + 1) * STEP)
    return directions_at(metal, u, v), np.hypot(u, v), np.degrees(np.arctan2(v, u))


def directions_at(metal, u, v):
    """Directions at angles along azimuth 0 and 90 degrees [degrees]."""
    pole, first = (np.array(each) / np.linalg.norm(each) for each in (metal.pole, metal.first))
    second = np.cross(pole, first)
    angle, azimuth = np.radians(np.hypot(u, v))[..., None], np.arctan2(v, u)[..., None]
    return np.cos(angle) * pole + np.sin(angle) * (np.cos(azimuth) * first + np.sin(azimuth) * second)


def densities(map, orientation, projection, metal):
    """Density per solid angle about the pole that is nearest to the axis, folded by its symmetry; NaN outside."""
    directions, angle, _ = grid(metal)
    group = ae.crystallography.point_group("fcc")  # that of bcc, too
    pole = np.array(metal.pole) / np.linalg.norm(metal.pole)
    own = [operation for operation in group if np.allclose(operation @ pole, pole)]
    to_pole = group[np.argmax(orientation.directions(group @ pole)[:, 2])]
    width, height = map.bin_size
    x, y = np.meshgrid(*map.centres)
    seen = projection.directions(np.column_stack([x.ravel(), y.ravel()])).reshape(*x.shape, 3)
    solid = np.linalg.norm(np.cross(np.gradient(seen, axis=1), np.gradient(seen, axis=0)), axis=-1)
    inside = map.mask & np.isfinite(map.values)
    sigma = np.radians(SMOOTHING) * projection.scale / np.array([height, width])
    counts, areas, covered = (
        gaussian_filter(np.where(inside, each, 0.0), sigma) for each in (map.values, solid, np.ones(x.shape))
    )
    with np.errstate(invalid="ignore", divide="ignore"):
        density = np.where(covered > _COVERED, counts / areas, np.nan)
    total, number = np.zeros(angle.shape), np.zeros(angle.shape)
    for operation in own:
        places = projection.places(orientation.directions(directions.reshape(-1, 3) @ operation.T @ to_pole.T))
        column = np.floor((places[:, 0] - map.x_edges[0]) / width).astype(int)
        row = np.floor((places[:, 1] - map.y_edges[0]) / height).astype(int)
        there = (column >= 0) & (column < x.shape[1]) & (row >= 0) & (row < x.shape[0])
        found = np.full(len(places), np.nan)
        found[there] = density[row[there], column[there]]
        found = found.reshape(angle.shape)
        known = np.isfinite(found)
        total[known] += found[known]
        number[known] += 1
    folded = np.full(angle.shape, np.nan)
    known = (number > 0) & (angle <= metal.reach)
    folded[known] = total[known] / number[known]
    return folded / np.nanmean(folded)


def flattened(folded):
    """Density divided by its broad mean."""
    known = np.isfinite(folded)
    sigma = BROAD / STEP
    broad = gaussian_filter(np.where(known, folded, 0.0), sigma) / gaussian_filter(known.astype(float), sigma)
    return folded / broad


def correlation(first, second):
    """Correlation of flattened maps."""
    a, b = flattened(first), flattened(second)
    known = np.isfinite(a) & np.isfinite(b)
    return float(np.corrcoef(a[known], b[known])[0, 1])


def rings(folded, metal):
    """Angular profile of each ring, relative to its mean, by 5 degrees of azimuth."""
    _, angle, azimuth = grid(metal)
    edges = np.arange(-180, 181, 5)
    profiles = []
    for inner, outer in metal.rings:
        known = np.isfinite(folded) & (angle >= inner) & (angle < outer)
        sums, _ = np.histogram(azimuth[known], edges, weights=folded[known])
        numbers, _ = np.histogram(azimuth[known], edges)
        profile = sums / np.maximum(numbers, 1)
        profiles.append(profile / profile[numbers > 0].mean())
    return profiles


def amplitude(profile, measured):
    """Factor by which a profile has the structure of the measured one."""
    return float(((profile - 1) @ (measured - 1)) / ((measured - 1) @ (measured - 1)))


def line_azimuths(folded, metal):
    """Azimuth of the bright line in each range of the angle [degrees], between 0 and 90 degrees."""
    _, angle, azimuth = grid(metal)
    found = []
    for inner, outer in metal.line:
        known = np.isfinite(folded) & (angle >= inner) & (angle < outer) & (azimuth > 5) & (azimuth < 85)
        edges = np.arange(5, 86, 2.5)
        sums, _ = np.histogram(azimuth[known], edges, weights=folded[known])
        numbers, _ = np.histogram(azimuth[known], edges)
        profile = gaussian_filter(sums / np.maximum(numbers, 1), 1.0)
        k = int(np.clip(np.argmax(profile), 1, len(profile) - 2))
        a, b, c = profile[k - 1 : k + 2]
        found.append(edges[k] + 1.25 + 2.5 * 0.5 * (a - c) / (a - 2 * b + c))
    return found


def radial(folded, metal):
    """Densities from the pole outwards, in bins of a quarter of the reach, in units of the mean."""
    _, angle, _ = grid(metal)
    edges = np.linspace(0, metal.reach, 5)
    return np.array([np.nanmean(folded[(angle >= a) & (angle < b)]) for a, b in pairwise(edges)])


def row(name, folded, target, metal):
    """Line of a table."""
    profiles = rings(folded, metal)
    wanted = rings(target, metal)
    contrasts = " ".join(f"{each.std():.2f}" for each in profiles)
    amplitudes = " ".join(f"{amplitude(a, b):5.2f}" for a, b in zip(profiles, wanted, strict=True))
    azimuths = " ".join(f"{each:4.1f}" for each in line_azimuths(folded, metal))
    densities_ = " ".join(f"{each:.2f}" for each in radial(folded, metal))
    print(f"{name:30} {correlation(folded, target):5.2f} | {azimuths} | {amplitudes} | {contrasts} | {densities_}")


def projection_of(run):
    """Projection with the image compression of the unperturbed ions between 8 degrees and 2 degrees from the rim."""
    hits = run.hits(ae.Unperturbed())
    crystal = np.empty(len(run))
    for cap in ae.analysis.fit_caps(run):
        sites = run.emissions.positions[cap.first : cap.last] - cap.centre
        crystal[cap.first : cap.last] = np.degrees(np.arccos(sites[:, 2] / np.linalg.norm(sites, axis=1)))
    seen = run.detector.seen_from_apex
    angles = np.degrees(seen.angles(np.column_stack([hits.x, hits.y])))
    known = hits.detected & (crystal > 8) & (crystal < run.settings["flights"]["field_of_view"] - 3)
    compression = float(np.median(crystal[known] / angles[known]))
    print(f"compression {compression:.3f}")
    return seen.compressed(compression)


def simulated_densities(run, metal):
    """Folded densities of every emission of a run."""
    projection = projection_of(run)
    orientation = ae.Orientation.from_settings(run.settings["tip"])
    edges = np.linspace(-60, 60, 481)
    middle = (edges[1:] + edges[:-1]) / 2
    half_angle = run.settings["flights"]["field_of_view"]
    seen = np.hypot(middle, middle[:, None]) < run.detector.distance * np.tan(np.radians(half_angle))
    found = {}
    for name, emission in zip(EMISSIONS, run.perturbations, strict=True):
        hits = run.hits(emission)
        there = hits.detected & (np.hypot(hits.x, hits.y) < 60)
        counts, _, _ = np.histogram2d(hits.y[there], hits.x[there], (edges, edges))
        map = ae.DetectorMap.from_array(counts, edges, edges, is_counts=True, mask=seen)
        found[name] = densities(map, orientation, projection, metal)
    return found


def main():
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("metal", choices=METALS)
    parser.add_argument("measured", help="ions, or a map of densities")
    parser.add_argument("runs", nargs="+", type=Path)
    options = parser.parse_args()
    metal = METALS[options.metal]
    map, orientation, projection, halves = measured_of(options.metal, options.measured)
    target = densities(map, orientation, projection, metal)
    row("measured", target, target, metal)
    if halves:
        print(f"two halves {correlation(*(densities(each, orientation, projection, metal) for each in halves)):.2f}")
    for path in options.runs:
        run = ae.load(path)
        print(f"{path.name}: {len(run):,} ions")
        folded = simulated_densities(run, metal)
        for name, density in folded.items():
            row(name, density, target, metal)
        for name in ("sharpness 0.15", "sharpness 0.4", "sharpness 2", "sharpness 0.4, height 0.2"):
            others = folded["lateral, height 0.2" if name.endswith("height 0.2") else "lateral"]
            for part in FRACTIONS:
                row(f"{name}, fraction {part:g}", (1 - part) * others + part * folded[name], target, metal)


if __name__ == "__main__":
    main()
