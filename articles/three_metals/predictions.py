"""Maps of other metals by the rule of `README.md`, before anyone compares: one run for each.

    python predictions.py simulate RUNS "Ni 001"     # or all of them, one after the other
    python predictions.py simulate RUNS "Ni 001" --specimen 2 --ions 330_000       # other atoms at the apex
    python predictions.py judge RUNS
    python predictions.py draw RUNS                  # predictions.png

Nothing is selected here: all constants of `RollUp.of_metal` are those of tungsten and nickel; cohesive energies are
Kittel's, fields those of `ae.material` (magnesium: Tsong). All atoms evaporate after a third as many without flights;
those within the field of view fly.
"""

import argparse
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import matplotlib.pyplot as plt
import numpy as np
from judge import map_of, projection_of
from runs import prepared

import apt_evap as ae

FIELD_OF_VIEW = 28.0  # degrees, half angle
SKIP = 120_000  # atoms that evaporate before the first ion flies, about a third of a layer


class Case(NamedTuple):
    """One map."""

    metal: str
    axis: tuple[int, ...]
    temperatures: tuple[float, ...] = (60.0,)  # K
    radius: int = 160  # in lattice constants


CASES = {
    "W 011": Case("W", (0, 1, 1), (60.0, 150.0), radius=100),
    "Ni 001": Case("Ni", (0, 0, 1)),
    "Fe 001": Case("Fe", (0, 0, 1)),
    "Fe 025": Case("Fe", (0, 2, 5)),
    "Fe 112": Case("Fe", (1, 1, 2)),
    "Cu 111": Case("Cu", (1, 1, 1)),
    "Pt 001": Case("Pt", (0, 0, 1)),
    "Mg 0001": Case("Mg", (0, 0, 1), (40.0,)),
    "Si 001": Case("Si", (0, 0, 1), radius=100),
}
MAGNESIUM = ae.Material("Mg", "hcp", 0.321, 21.0, 2, 24.305, c=0.521, cohesive_energy=1.51)


def material_of(case):
    """The metal of a case."""
    return MAGNESIUM if case.metal == "Mg" else ae.material(case.metal)


def laws(case):
    """The law of each temperature."""
    return [ae.emission.Migration.of(material_of(case), temperature) for temperature in case.temperatures]


def simulated(case, ions, specimen, threads):
    """Run of one case: unperturbed, and the rule at each temperature; another specimen has other atoms at the apex."""
    material = material_of(case)
    size = case.radius * material.a
    tip = ae.Tip(material, size, axis=case.axis, shank_length=size, depth=8 * material.a, offset_seed=specimen)
    simulation, scale = prepared(tip, ae.ConstantPotential(), FIELD_OF_VIEW, SKIP, specimen, threads)
    rolls = [ae.RollUp.of_metal(material, each, scale) for each in case.temperatures]
    return simulation.run(ions, [ae.Unperturbed(), *rolls], responses=False, progress=False)


def files_of(runs, name):
    """Files of the specimens of a case."""
    return sorted(runs.glob(f"{name.replace(' ', '_')}_[0-9]*.h5"))


def lines_about(pole, normals, labels):
    """Directions of lines from a pole: those of one kind of azimuth together, named by the poles on them."""
    groups = {}
    cosines = normals @ pole
    first = np.linalg.svd(pole[None])[2][1]
    azimuths = np.degrees(np.arctan2(normals @ np.cross(pole, first), normals @ first)) % 360
    for family in dict.fromkeys(labels):
        for angle in np.unique(np.round(cosines[labels == family], 6)):
            if not np.cos(np.radians(60)) < angle < np.cos(np.radians(4)):
                continue
            chosen = (labels == family) & (np.round(cosines, 6) == angle)
            key = tuple(sorted({round(each) % 360 for each in azimuths[chosen]}))
            groups.setdefault(key, ([], normals[chosen]))[0].append((np.degrees(np.arccos(angle)), family))
    return [(", ".join(name for _, name in sorted(names)[:2]), toward) for names, toward in groups.values()]


def across(map, projection, pole, toward, outer):
    """Density on the line, 1 to 2 degrees beside it, and their errors, over that 3 to 6 degrees beside it."""
    profile = ae.maps.pole_line_profile(map, projection, pole, toward, inner=4, outer=outer, width=12, bins=36)
    away = np.abs(profile.position)
    parts = []
    for low, high in ((0, 0.67), (1, 2), (3, 6)):
        chosen = (away >= low) & (away < high) & np.isfinite(profile.density)
        mean = profile.density[chosen].mean()
        parts.append((mean, np.sqrt(np.sum(profile.error[chosen] ** 2)) / np.count_nonzero(chosen)))
    ground, error = parts[2]
    return [(mean / ground, np.hypot(own, mean / ground * error) / ground) for mean, own in parts[:2]]


def statement(line, flank):
    """A line in a word."""
    (centre, error), (side, side_error) = line, flank
    if centre > 1.1 and centre - 1 > 3 * error:
        return "bright"
    if side < 0.9 and centre - side > max(0.1, 3 * np.hypot(error, side_error)):
        return "dark doublet"
    if centre < 0.9 and 1 - centre > 3 * error:
        return "dark"
    return "nothing"


class Shown(NamedTuple):
    """What the specimens of a case show."""

    orientation: ae.Orientation
    projections: list[ae.detection.Projection]
    """That of all specimens together, then that of each."""
    maps: list[list[ae.DetectorMap]]
    """The same for each emission."""
    parts: list[float]
    """Part of all atoms that roll, also of those outside the map, at each temperature."""


def shown_by(case, paths):
    """Maps of all specimens together and of each, with their ions added up."""
    runs = [ae.load(path) for path in paths]
    projections = [projection_of(run) for run in runs]
    mean = {name: np.mean([getattr(each, name) for each in projections]) for name in ("scale", "compression")}
    maps = []
    for number in range(1 + len(case.temperatures)):
        own = [map_of(run, run.perturbations[number]) for run in runs]
        counts = sum(each.counts for each in own)
        both = ae.DetectorMap.from_array(counts, own[0].x_edges, own[0].y_edges, is_counts=True, mask=own[0].mask)
        maps.append([both, *own])
    parts = [np.concatenate([law.probabilities(run.emissions) for run in runs]).mean() for law in laws(case)]
    orientation = ae.Orientation.from_settings(runs[0].settings["tip"])
    return Shown(orientation, [replace(projections[0], **mean), *projections], maps, parts)


def judged(name, paths):
    """Print what the maps of a case show: all specimens together, and in brackets each of them."""
    case, shown = CASES[name], shown_by(CASES[name], paths)
    found = ae.maps.poles(shown.orientation.material, 10)
    labels = np.array(["{" + "".join(str(each) for each in np.sort(np.abs(plane))) + "}" for plane in found.planes])
    normals = shown.orientation.directions(found.normals)
    away = np.degrees(np.arccos(np.clip(normals[:, 2], -1, 1)))
    near = [int(each) for each in np.argsort(away)[:2] if away[each] < 8] or [int(np.argmin(away))]
    names = ["unperturbed", *(f"rule at {each:g} K, {part:.0%} roll" for each, part in zip(
        case.temperatures, shown.parts, strict=True
    ))]  # fmt: skip
    for text, maps in zip(names, shown.maps, strict=True):
        print(f"{name}, {text}: {maps[0].shown_ions}")
        for index in near:
            pole, outer = normals[index], FIELD_OF_VIEW - 2 - away[index]
            radial = [
                ae.maps.pole_profile(map, projection, pole, np.arange(0, min(outer, 14), 1.0)).density
                for map, projection in zip(maps, shown.projections, strict=True)
            ]
            print(f"  {labels[index]}, density by degree", " ".join(f"{each:.2f}" for each in radial[0][:8]),
                  *(f"({' '.join(f'{each:.2f}' for each in own[:4])})" for own in radial[1:]))  # fmt: skip
            if text == names[0]:
                continue
            for towards, directions in lines_about(pole, normals, labels):
                line, flank = across(maps[0], shown.projections[0], pole, directions, min(outer, 16))
                own = [
                    across(map, projection, pole, directions, min(outer, 16))
                    for map, projection in zip(maps[1:], shown.projections[1:], strict=True)
                ]
                each = [f"({a:.2f}, {b:.2f})" for (a, _), (b, _) in own]
                words = [statement(*of_one) for of_one in own]
                print(f"    {towards:16} on the line {line[0]:.2f} +- {line[1]:.2f}, beside it {flank[0]:.2f} +- "
                      f"{flank[1]:.2f}", *each, f"{statement(line, flank)}"
                      f"{'' if len(set(words)) == 1 else ' (' + ', '.join(words) + ')'}")  # fmt: skip


def draw(runs, path):
    """Maps of all cases that have a run, with their poles."""
    files = {name: files_of(runs, name) for name in CASES}
    files = {name: paths for name, paths in files.items() if paths}
    figure, axes = plt.subplots(-(-len(files) // 3), 3, squeeze=False, layout="constrained", figsize=(11, 11.6))
    for ax, (name, paths) in zip(axes.flat, files.items(), strict=False):
        shown = shown_by(CASES[name], paths)
        map, projection = shown.maps[1][0], shown.projections[0]
        metal, axis = name.split()
        title = f"{metal} [{axis}], {shown.parts[0]:.0%} roll"
        ae.plot.detector_map(map.flattened(15.0).smoothed(0.9), ax, title=title, colorbar=False, caption=False)
        half = projection.scale * projection.compression * np.tan(np.radians(FIELD_OF_VIEW - 1))
        ax.set(xlim=(-half, half), ylim=(-half, half))
        ae.plot.poles(ax, shown.orientation, projection, families=6, zone_families=(), region=map, size=7)
    for ax in axes.flat[len(files) :]:
        ax.remove()
    figure.savefig(path, dpi=75)


def main():
    """Simulate, or print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("what", choices=("simulate", "judge", "draw"))
    parser.add_argument("runs", type=Path)
    parser.add_argument("cases", nargs="*", default=list(CASES))
    parser.add_argument("--ions", type=int, default=360_000, help="atoms that evaporate and fly if they can arrive")
    parser.add_argument("--specimen", type=int, default=1, help="1, 2, ...: other atoms at the apex")
    parser.add_argument("--threads", type=int)
    options = parser.parse_args()
    options.runs.mkdir(parents=True, exist_ok=True)
    if options.what == "draw":
        draw(options.runs, "predictions.png")
        return
    for name in options.cases:
        path = options.runs / f"{name.replace(' ', '_')}_{options.specimen}.h5"
        if options.what == "simulate":
            if not path.exists():
                simulated(CASES[name], options.ions, options.specimen, options.threads).save(path)
        elif paths := files_of(options.runs, name):
            judged(name, paths)


if __name__ == "__main__":
    main()
