"""
Cap and evolving surface beside the truth
=========================================

Reconstructs the runs of ``runs.py`` by the cap and by a surface that follows the ions, with the true phase of each ion
and with the local composition of solutes, and compares both with the true sites: errors, sizes, densities, ions on the
wrong side of an interface, evaporation fields, and how often the intervals of the positions hold the truth. Radius and
compression are those that fit the run of pure aluminium; the efficiency is known. Other rows have a voltage with noise,
a jump and a restart, constants from the map of the hits, or constants that are wrong by 5 %, drawn at random. ``python
table.py -i runs -o out`` prints the table and writes ``cases.json``, ``table.rst`` (median and range over the cases),
``seeds.rst`` (the same over the seeds of each geometry), and ``sections.png``.
"""

import argparse
import json
import sys
import time
from pathlib import Path

import numpy as np
import runs
import scipy

import apt_evap as ae

sys.path.append(str(Path(__file__).parents[2] / "benchmarks" / "ground_truth"))
import baselines

RADIUS, COMPRESSION = 12.963, 1.0342  # fitted to the sites of the pure run, R = 12 nm
EFFICIENCY, HALF_ANGLE, DISTANCE = 0.5, 30.0, 100.0
CONTRASTS = {"solute": 0.4, "20/2 %": 0.2, "6/2 %": 0.06}  # content of the phases, 2 % in the matrix
CHOSEN_ON = ("pure_1", "sphere_high_1", "layer_high_1")
PHASE_FIELDS = {
    "sphere_low": [0.8], "sphere_small": [0.8], "sphere_low_off": [0.8], "sphere_high": [1.2],
    "sphere_edge": [0.85], "layer_high": [1.15],
    "layer_low": [0.85], "layer40_high": [1.15], "layer40_low": [0.85], "two_spheres": [0.8, 1.2],
    "core_shell": [1.15, 0.85], "pure": [],
}  # fmt: skip
EXACT = dict.fromkeys(("compression", "radius", "efficiency"), 0.0)
DRAWS = 4  # of wrong constants


def detected(path, emission="rest", way="labels", seed=7):
    """Ions that the detector recorded: hits with a voltage and solutes that are drawn, sites and phases."""
    kept = np.load(path)
    places = kept[emission].astype(float)
    rho = np.hypot(*places.T)
    rng = np.random.default_rng(seed)
    rows = np.isfinite(rho) & (rho < DISTANCE * np.tan(np.radians(HALF_ANGLE)))
    rows &= rng.random(len(rows)) < EFFICIENCY
    # the voltage of a rate that is controlled: that of the sites, averaged over 0.15 nm of 8.4 nm
    voltage = scipy.ndimage.gaussian_filter1d(kept["voltage"], 0.15 / 8.4 * len(rows), mode="nearest")
    phase = kept["phase"].astype(int)
    content = np.where(phase > 0, CONTRASTS.get(way, 0.4), 0.02)
    element = np.where(rng.random(len(phase)) < content, "Cu", "Al")
    if path.stem.startswith("alloy"):  # in the others the species is that of the phase
        element = np.where(kept["species"] > 0, "Cu", "Al")
    if way == "two solutes":
        element = np.where(element == "Al", "Al", np.where(rng.random(len(phase)) < 0.5, "Cu", "Mg"))
        element[(element != "Al") & (phase == 1)], element[(element != "Al") & (phase == 2)] = "Cu", "Mg"
    voltage, element, n = voltage[rows], element[rows], int(rows.sum())
    if way == "noisy voltage":  # 0.5 % from ion to ion, and 0.5 % that wanders over 2 % of the ions
        slow = scipy.ndimage.gaussian_filter1d(rng.normal(size=n), n / 50)
        voltage = voltage * (1 + 0.005 * rng.normal(size=n) + 0.005 * slow / slow.std())
    elif way == "jump and restart":  # 4 % at once, and a start at 0.9 that recovers over 0.5 % of the ions
        voltage = voltage * np.where(np.arange(n) > 0.6 * n, 1.04, 1.0) * (1 + 0.002 * rng.normal(size=n))
        since = np.arange(n) - round(0.35 * n)
        voltage *= np.where(since >= 0, 1 - 0.1 * np.exp(-np.maximum(since, 0) / (0.005 * n)), 1.0)
    hits = ae.Hits(x=places[rows, 0], y=places[rows, 1], voltage=voltage, extra={"element": element})
    return hits, kept["sites"][rows], phase[rows]


def reconstructed(hits, factors=(1.0, 1.0, 1.0), **how):
    """Reconstruction with the constants of all cases, times factors of compression, radius and efficiency."""
    how = {name: how[name] * factors[1] if name in ("radius", "initial_radius") and how[name] != "shank" else how[name]
           for name in how}  # fmt: skip
    return ae.reconstruct(
        hits, atomic_volume=runs.VOLUME, distance=DISTANCE, detector_radius=DISTANCE * np.tan(np.radians(HALF_ANGLE)),
        efficiency=EFFICIENCY * factors[2], projection="compressed", compression=COMPRESSION * factors[0], **how,
    )  # fmt: skip


def factors_of_map(hits):
    """Compression by the poles of the map, and radius by the planes of a pole, from 0.9 of the right one: over ours."""
    given = {
        "distance": DISTANCE, "efficiency": EFFICIENCY, "atomic_volume": runs.VOLUME, "crystal": "fcc",
        "field_of_view": 2 * DISTANCE * np.tan(np.radians(HALF_ANGLE)), "material": "Al", "a": runs.ALUMINIUM.a,
    }  # fmt: skip
    found, compression = baselines.orientation(hits, given)
    radius = 0.9 * RADIUS
    for _ in range(2):
        radius = baselines.calibrated_radius(hits, given, found, radius, compression) or radius
    return compression / COMPRESSION, radius / RADIUS, 1.0


def measured(found, sites, phase, regions):
    """Errors, and sizes, density and wrong side of each phase."""
    positions = found.specimen_positions
    positions = positions + (sites - positions).mean(axis=0)
    errors = positions - sites
    row = {"lateral": np.sqrt((errors[:, :2] ** 2).sum(axis=1).mean()), "depth": np.sqrt((errors[:, 2] ** 2).mean())}
    row["phases"] = []
    for number, region in enumerate(regions, 1):
        ions = phase == number
        if ions.sum() < 50:
            continue
        if hasattr(region, "normal"):
            axis = np.array(region.normal) / np.linalg.norm(region.normal)
        else:
            axis = np.array(region.centre) / np.linalg.norm(region.centre)
        along = [(part[ions] - part[ions].mean(axis=0)) @ axis for part in (positions, sites)]
        across = [
            (part[ions] - part[ions].mean(axis=0)) - line[:, None] * axis
            for part, line in zip((positions, sites), along, strict=True)
        ]
        thick = along[0].std() / along[1].std()
        wide = np.sqrt((across[0] ** 2).sum() / (across[1] ** 2).sum())
        true, apparent = region.distance(sites), region.distance(positions)
        side = np.sign(np.median(true[ions]))
        depth_inside = 0.3 * np.abs(true[ions]).max()
        inner = [np.count_nonzero(side * part > depth_inside) for part in (apparent, true)]
        near = np.abs(apparent) < 0.5
        # of nested phases, what is inside the outer one
        inside = true * side > 0
        wrong = np.mean((np.sign(apparent[near]) == side) != inside[near])
        row["phases"].append({"wide": wide, "thick": thick, "density": inner[0] / inner[1], "wrong": wrong})
    return row


def coverage(found, sites, errors):
    """Part of the ions whose true site is within 1 and 2 standard deviations, lateral and in depth."""
    covariances = ae.reconstruction.position_covariances(found, errors)
    errors = found.specimen_positions - sites
    ratio = np.abs(errors - errors.mean(axis=0)) / np.sqrt(np.einsum("nii->ni", covariances))
    return [float((part < sigmas).mean()) for sigmas in (1, 2) for part in (ratio[:, :2], ratio[:, 2])]


def ways_of(base, emission, regions):
    """Methods beside the cap, and how each calls for its phases."""
    if not regions:
        return {"ring": ()}
    ways = {"labels": None}
    if emission == "rest":
        ways |= dict.fromkeys(CONTRASTS, ("Cu",))
        ways |= {"noisy voltage": None, "jump and restart": None, "constants of the map": None, "wrong constants": None}
    if base == "alloy_sphere":
        return {"labels": None, "solute": ("Cu",)}
    if base == "two_spheres":
        ways["two solutes"] = ("Cu", "Mg")
    return ways


def compare(path, emission="rest", chosen=None, twin=None):
    """One case by all methods, or by some, and with a twin: rows of the table."""
    name = path.stem.rsplit("_", 1)[0]
    base = name.split("-")[0]
    phases, shank, _, apex = runs.case(name)
    regions = [one.region for one in phases[1:]]
    radius = RADIUS * apex / runs.R
    growth = {"radius": radius}
    if shank > 1.5:
        growth = {"radius": "shank", "initial_radius": radius, "shank_angle": shank}
    hits, sites, phase = detected(path, emission)
    rows = {"cap": measured(reconstructed(hits, **growth), sites, phase, regions)}
    rng = np.random.default_rng(sum(map(ord, path.stem)))
    for way, solutes in ways_of(base, emission, regions).items():
        if chosen and way not in chosen:
            continue
        hits, sites, phase = detected(path, emission, way)
        how = {"labels": phase} if solutes is None else {"solutes": solutes}
        start = time.process_time()
        if way == "wrong constants":
            held = []
            for _ in range(DRAWS):
                found = reconstructed(hits, 1 + 0.05 * rng.normal(size=3), shape="evolving", **growth, **how)
                if found.history is not None:
                    held.append(coverage(found, sites, None))
            rows[way] = {"coverage": np.mean(held, axis=0).tolist()} if held else {}
            continue
        factors = factors_of_map(hits) if way == "constants of the map" else (1.0, 1.0, 1.0)
        found = reconstructed(hits, factors, shape="evolving", **growth, **how)
        row = measured(found, sites, phase, regions)
        row["seconds"] = time.process_time() - start
        row["verdict"], row["fields"] = found.verdict, [(one.ratio, one.error) for one in found.phases]
        if emission == "rest" and found.history is not None and way in ("labels", "ring"):
            row["coverage"] = coverage(found, sites, EXACT)
        rows[way] = row
        if twin is not None and way in ("labels", "ring"):
            found = reconstructed(hits, shape="evolving", twin=twin, **growth, **how)
            rows[f"{way}, twin"] = row = measured(found, sites, phase, regions) | {"verdict": found.verdict}
            if found.history is not None:
                row["coverage"] = coverage(found, sites, EXACT)
    true = PHASE_FIELDS.get(base, [])
    return {"name": path.stem + ("" if emission == "rest" else f" ({emission})"), "true": true, "rows": rows}


def lines_of(case):
    """Lines of the table, one for each method."""
    for way, row in case["rows"].items():
        phases = "; ".join(
            f"{one['wide']:.2f} / {one['thick']:.2f}, {one['density']:.2f}, {one['wrong']:.2f}"
            for one in row.get("phases", [])
        )
        fields = "; ".join(f"{ratio:.3f} ± {error:.3f}" for ratio, error in row.get("fields", []))
        held = " / ".join(f"{part:.2f}" for part in row.get("coverage", []))
        errors = f"{row['lateral']:.3f} / {row['depth']:.3f}" if "lateral" in row else ""
        yield [case["name"], way, errors, phases, fields, held], row.get("verdict", "")


def summary(cases):
    """Lines of the table of medians and ranges over the cases, one for each method."""

    def over(values, digits=2):
        values = np.asarray(values, float).ravel()
        if not len(values):
            return ""
        return f"{np.median(values):.{digits}f} ({values.min():.{digits}f} to {values.max():.{digits}f})"

    for way in dict.fromkeys(way for case in cases for way in case["rows"]):
        rows = [(case["rows"][way], case["rows"]["cap"]) for case in cases if way in case["rows"]]
        followed = [(row, cap) for row, cap in rows if not row.get("verdict", "").startswith("cap")]
        phases = [one for row, _ in followed for one in row.get("phases", [])]
        held = np.array([row["coverage"] for row, _ in followed if "coverage" in row])
        yield [
            way, f"{len(followed)} of {len(rows)}",
            over([row["lateral"] for row, _ in followed if "lateral" in row]),
            over([row["depth"] for row, _ in followed if "depth" in row]),
            over([row["lateral"] / cap["lateral"] for row, cap in followed if "lateral" in row]),
            over([row["depth"] / cap["depth"] for row, cap in followed if "lateral" in row]),
            over([one[side] for one in phases for side in ("wide", "thick")]),
            over([one["density"] for one in phases]), over([one["wrong"] for one in phases]),
            " / ".join(f"{part:.2f}" for part in held.mean(axis=0)) if len(held) else "",
        ]  # fmt: skip


def by_geometry(cases):
    """Lines of the table of medians and ranges over the seeds of each geometry."""
    geometries = dict.fromkeys(case["name"].rsplit("_", 1)[0] for case in cases)
    for geometry in geometries:
        seeds = [case for case in cases if case["name"].rsplit("_", 1)[0] == geometry]
        for way, _, *values in summary(seeds):
            if len(seeds) > 1 and way != "wrong constants":
                yield [f"{geometry}, {len(seeds)} seeds", way, *values]


def draw(paths, output):
    """Sections through true sites, cap and evolving surface, and what the model measured."""
    figure = ae.plot.new_figure((13.0, 3.3 * len(paths)))
    figure.set_layout_engine("constrained")
    panels = figure.subplots(len(paths), 4, squeeze=False)
    for ax in panels[:, :3].ravel()[1:]:
        ax.sharex(panels[0, 0])
        ax.sharey(panels[0, 0])
    for axes, path in zip(panels, paths, strict=True):
        name = path.stem.rpartition("_")[0]
        hits, sites, phase = detected(path)
        found = reconstructed(hits, radius=RADIUS, shape="evolving", labels=phase)
        cap = reconstructed(hits, radius=RADIUS)
        near = np.abs(sites[:, 1]) < 1.0
        for ax, positions, title in (
            (axes[0], sites, "true sites"),
            (axes[1], cap.specimen_positions, "cap"),
            (axes[2], found.specimen_positions, "evolving surface"),
        ):
            positions = positions + (sites - positions).mean(axis=0)
            for kind, color in ((phase == 0, "0.75"), (phase > 0, "C3")):
                ax.scatter(*positions[near & kind][:, [0, 2]].T, s=2, color=color, linewidths=0, rasterized=True)
            ax.set(aspect="equal", xlabel="x [nm]", ylabel="z [nm]", title=title)
        history = found.history
        axes[3].plot(history.depths, history.recession, label="recession / cap")
        axes[3].plot(history.depths, history.voltage, label="voltage, measured")
        axes[3].plot(history.depths, history.model_voltage, label="voltage, model")
        axes[3].set(xlabel="depth of the apex [nm]", ylim=(0.3, 2.2))
        axes[3].legend(fontsize="small")
        (ratio,) = PHASE_FIELDS[name]
        axes[0].set_title(f"true sites, {name.split('_')[0]} of {ratio:g} times the field")
    figure.savefig(output / "sections.png", dpi=110)


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("-i", "--input", type=Path, default=Path("runs"), help="folder of the runs; default: runs")
    parser.add_argument("-o", "--output", type=Path, default=Path(), help="folder of table and picture")
    parser.add_argument("--only", nargs="*", metavar="NAME_SEED", help="cases; default: all, and the picture")
    parser.add_argument("--ways", nargs="*", metavar="METHOD", help="methods beside the cap; default: all")
    parser.add_argument(
        "--twin", type=Path, metavar="RUN.h5", help="run of the matrix alone, for more rows; default: none"
    )
    options = parser.parse_args()
    twin = None if options.twin is None else ae.load(options.twin)
    kept = options.output / "cases.json"
    cases = json.loads(kept.read_text()) if options.only and kept.exists() else {}
    paths = sorted(options.input.glob("*.npz"))
    for path in paths:
        if options.only and path.stem not in options.only:
            continue
        for emission in ("rest", "metal", "all") if "-rolled" in path.stem else ("rest",):
            case = compare(path, emission, options.ways, twin)
            cases[case["name"]] = case
            for row, verdict in lines_of(case):
                print(" | ".join(row), "|", verdict, flush=True)
            kept.write_text(json.dumps(cases, indent=1, default=float))
    rest = [case for name, case in cases.items() if "(" not in name]
    judged = [case for case in rest if case["name"] not in CHOSEN_ON]
    header = ["method", "followed", "lateral [nm]", "depth [nm]", "lateral over cap", "depth over cap",
              "width and thickness", "density", "wrong side", "coverage"]  # fmt: skip
    for name, rows in (
        ("table.rst", [header, *summary(judged)]),
        ("seeds.rst", [["geometry", "method", *header[2:]], *by_geometry(rest)]),
    ):
        table = [".. list-table::\n   :header-rows: 1\n"]
        table += ["   * - " + "\n     - ".join(row) for row in rows]
        (options.output / name).write_text("\n".join(table) + "\n")
    if not options.only:
        chosen = [path for path in paths if path.stem in ("layer_high_1", "sphere_low_1")]
        draw(chosen, options.output)


if __name__ == "__main__":
    main()
