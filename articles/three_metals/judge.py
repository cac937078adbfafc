"""Runs of `runs.py` against a measured map: folded correlation, place of the lines, rings, densities.

    python judge.py W W3.epos RUNS/W_160_others_1.h5

Both maps are sampled about the same pole, at equal directions of the crystal, and folded by its symmetry. The measured
directions are those of the indexing; the simulated ones have the image compression of the unperturbed ions. The
correlation is that of flattened densities, smoothed by 0.6 degrees. A line of the table: correlation, azimuth of the
bright line in ranges of the angle, amplitudes and contrasts of three rings, densities from the pole outwards; for
tungsten the densities on the lines towards {222} and {200}. A run with responses is judged by `RollUp.of_metal`. With
--errors, also the errors of counting of the contrasts, from 20 maps with other counts.
"""

import argparse
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from typing import NamedTuple

import numpy as np
from runs import EMISSIONS
from scipy.ndimage import gaussian_filter

import apt_evap as ae

FRACTIONS = (0.0, 0.05, 0.2, 0.4, 0.5, 0.6, 0.7, 0.8, 0.9, 1.0)


class Metal(NamedTuple):
    """How a measured map is compared."""

    pole: tuple[int, int, int]
    reach: float
    """Largest angle from the pole [degrees]."""
    rings: tuple[tuple[float, float], ...]
    line: tuple[tuple[float, float], ...]
    """Ranges of the angle in which the azimuth of the bright line is measured [degrees]."""


METALS = {
    "W": Metal((0, 1, 1), 15.5, ((4, 7), (7, 11), (11, 15.5)),
               ((5.1, 7.0), (7.0, 9.5), (9.5, 12.7), (12.7, 15.5))),
    "Ni": Metal((1, 1, 1), 18.0, ((5, 9), (9, 14), (14, 18)), ()),
    # two orientations explain the map of aluminium; both have a (111) pole at the same place
    "Al": Metal((1, 1, 1), 12.0, ((5, 9), (9, 12)), ()),
    "Al-2": Metal((1, 1, 1), 12.0, ((5, 9), (9, 12)), ()),
}  # fmt: skip


def measured_of(metal, path):
    """Measured map, its orientation and projection."""
    if metal == "Ni":
        # three named poles; without them the map is undecided
        orientation = ae.Orientation("Ni", axis=(0.2926, 0.5418, 0.7879), rotation=155.31)
        return ae.io.read_map(path), orientation, ae.detection.Projection(26.1013, centre=(0.4029, -0.3919))
    if metal.startswith("Al"):
        found = ae.index(ae.io.read_map(path), "Al")
        candidate = found.candidates[metal == "Al-2"]
        print(candidate)
        return found.map, candidate.orientation, candidate.projection
    ions = path if isinstance(path, ae.Hits) else ae.read(path)
    map = ions.map(bins=256)
    found = ae.index(map, metal, distance=305.0)
    print(found)
    return map, found.best.orientation, found.best.projection


def folded(map, orientation, projection, metal):
    """The map, folded about its pole."""
    return ae.maps.folded(map, projection, *orientation.nearest_pole(metal.pole), reach=metal.reach)


def polar(folded):
    """Angles from the pole and azimuths of the cells [degrees]."""
    u, v = np.meshgrid(folded.angles, folded.angles)
    return np.hypot(u, v), np.degrees(np.arctan2(v, u))


def rings(folded, metal):
    """Angular profile of each ring, relative to its mean, by 5 degrees of azimuth."""
    angle, azimuth = polar(folded)
    edges = np.arange(-180, 181, 5)
    profiles = []
    for inner, outer in metal.rings:
        known = np.isfinite(folded.density) & (angle >= inner) & (angle < outer)
        sums, _ = np.histogram(azimuth[known], edges, weights=folded.density[known])
        numbers, _ = np.histogram(azimuth[known], edges)
        profile = sums / np.maximum(numbers, 1)
        profiles.append(profile / profile[numbers > 0].mean())
    return profiles


def amplitude(profile, measured):
    """Factor by which a profile has the structure of the measured one."""
    return float(((profile - 1) @ (measured - 1)) / ((measured - 1) @ (measured - 1)))


def line_azimuths(folded, metal):
    """Azimuth of the bright line in each range of the angle [degrees], between 0 and 90 degrees."""
    angle, azimuth = polar(folded)
    found = []
    for inner, outer in metal.line:
        known = np.isfinite(folded.density) & (angle >= inner) & (angle < outer) & (azimuth > 5) & (azimuth < 85)
        edges = np.arange(5, 86, 2.5)
        sums, _ = np.histogram(azimuth[known], edges, weights=folded.density[known])
        numbers, _ = np.histogram(azimuth[known], edges)
        profile = gaussian_filter(sums / np.maximum(numbers, 1), 1.0)
        k = int(np.clip(np.argmax(profile), 1, len(profile) - 2))
        a, b, c = profile[k - 1 : k + 2]
        found.append(edges[k] + 1.25 + 2.5 * 0.5 * (a - c) / (a - 2 * b + c))
    return found


def mirror_lines(folded):
    """Density within 0.67 degrees of the mirror lines at 0 and 90 degrees of azimuth, over that 3 to 6 degrees beside.

    About (011) of bcc they lead to {222} and {200}.
    """
    u, v = np.meshgrid(folded.angles, folded.angles)
    found = []
    for along, beside in ((u, np.abs(v)), (v, np.abs(u))):
        there = np.isfinite(folded.density) & (along >= 4) & (along < 14)
        on, away = (folded.density[there & (beside >= a) & (beside < b)].mean() for a, b in ((0, 0.67), (3, 6)))
        found.append(on / away)
    return found


def radial(folded, metal):
    """Densities from the pole outwards, in bins of a quarter of the reach, in units of the mean."""
    angle, _ = polar(folded)
    edges = np.linspace(0, metal.reach, 5)
    return np.array([np.nanmean(folded.density[(angle >= a) & (angle < b)]) for a, b in pairwise(edges)])


def row(name, folded, target, metal):
    """Line of a table."""
    profiles = rings(folded, metal)
    wanted = rings(target, metal)
    contrasts = " ".join(f"{each.std():.2f}" for each in profiles)
    amplitudes = " ".join(f"{amplitude(a, b):5.2f}" for a, b in zip(profiles, wanted, strict=True))
    azimuths = " ".join(f"{each:4.1f}" for each in line_azimuths(folded, metal))
    densities_ = " ".join(f"{each:.2f}" for each in radial(folded, metal))
    ends = " | " + " ".join(f"{each:.2f}" for each in mirror_lines(folded)) if metal.line else ""
    print(f"{name:30} {folded.correlation(target):5.2f} | {azimuths} | {amplitudes} | {contrasts} | {densities_}{ends}")


def contrast_errors(map, orientation, projection, metal, seed=1):
    """Contrasts of the rings and their errors of counting, as text."""
    random, found = np.random.default_rng(seed), []
    for _ in range(20):
        counts = random.poisson(np.where(map.mask, map.values, 0))
        other = ae.DetectorMap.from_array(counts, map.x_edges, map.y_edges, is_counts=True, mask=map.mask)
        found.append([each.std() for each in rings(folded(other, orientation, projection, metal), metal)])
    contrasts = [each.std() for each in rings(folded(map, orientation, projection, metal), metal)]
    return " ".join(f"{each:.3f} +- {error:.3f}" for each, error in zip(contrasts, np.std(found, axis=0), strict=True))


def projection_of(run):
    """Projection with the image compression of the unperturbed ions between 8 degrees and 2 degrees from the rim."""
    hits = run.hits(ae.Unperturbed())
    crystal = np.empty(len(run))
    for cap in ae.simulation.fit_caps(run):
        sites = run.emissions.positions[cap.first : cap.last] - cap.centre
        crystal[cap.first : cap.last] = np.degrees(np.arccos(sites[:, 2] / np.linalg.norm(sites, axis=1)))
    seen = run.detector.seen_from_apex
    angles = np.degrees(seen.angles(np.column_stack([hits.x, hits.y])))
    known = hits.detected & (crystal > 8) & (crystal < run.settings["flights"]["field_of_view"] - 3)
    compression = float(np.median(crystal[known] / angles[known]))
    print(f"compression {compression:.3f}")
    return seen.compressed(compression)


def map_of(run, emission):
    """Map of the field of view of the flights."""
    edges = np.linspace(-60, 60, 481)
    middle = (edges[1:] + edges[:-1]) / 2
    half_angle = run.settings["flights"]["field_of_view"]
    seen = np.hypot(middle, middle[:, None]) < run.detector.distance * np.tan(np.radians(half_angle))
    hits = run.hits(emission)
    there = hits.detected & (np.hypot(hits.x, hits.y) < 60)
    counts, _, _ = np.histogram2d(hits.y[there], hits.x[there], (edges, edges))
    return ae.DetectorMap.from_array(counts, edges, edges, is_counts=True, mask=seen)


def emissions_of(run):
    """Emissions of a run of `runs.py` by name; the one law for a run with responses."""
    if len(run.perturbations) == len(EMISSIONS):
        return dict(zip(EMISSIONS, run.perturbations, strict=True))
    if run.perturbations:
        rule = run.perturbations[-1]
    else:
        scale = float(np.median(run.at_evaporation_field().energy_scales))
        rule = ae.RollUp.of_metal(run.settings["tip"]["material"]["name"], energy_scale=scale)
    return {"unperturbed": ae.Unperturbed(), "law of migration": rule}


def main():
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("metal", choices=METALS)
    parser.add_argument("measured", help="ions, or a map of densities")
    parser.add_argument("runs", nargs="+", type=Path)
    parser.add_argument("--errors", action="store_true", help="of the contrasts, by counting")
    options = parser.parse_args()
    metal = METALS[options.metal]
    map, orientation, projection = measured_of(options.metal, options.measured)
    target = folded(map, orientation, projection, metal)
    row("measured", target, target, metal)
    print(target)
    if options.errors and map.is_counts:
        print("contrasts", contrast_errors(map, orientation, projection, metal))
    for path in options.runs:
        run = ae.load(path)
        print(f"{path.name}: {len(run):,} ions")
        place = ae.Orientation.from_settings(run.settings["tip"]), projection_of(run)
        maps = {name: map_of(run, emission) for name, emission in emissions_of(run).items()}
        simulated = {name: folded(each, *place, metal) for name, each in maps.items()}
        for name, each in simulated.items():
            row(name, each, target, metal)
            if options.errors:
                print("contrasts", contrast_errors(maps[name], *place, metal))
        if len(simulated) == 2:
            continue
        for name in ("sharpness 0.15", "sharpness 0.4", "sharpness 2", "sharpness 0.4, height 0.2"):
            others = simulated["lateral, height 0.2" if name.endswith("height 0.2") else "lateral"]
            for part in FRACTIONS:
                density = (1 - part) * others.density + part * simulated[name].density
                row(f"{name}, fraction {part:g}", replace(others, density=density), target, metal)


if __name__ == "__main__":
    main()
