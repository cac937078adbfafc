"""
Cap and evolving surface beside the truth
=========================================

Reconstructs the runs of ``runs.py`` by the cap and by a surface that follows the ions, with the true phase of each ion
and with the local composition of solutes, and compares both with the true sites: errors, sizes, densities, ions on the
wrong side of an interface, evaporation fields, and how often the intervals of the positions hold the truth. Radius and
compression are those that fit the run of pure aluminium; the efficiency is known. Other rows have a voltage with noise,
a jump and a restart, constants from the map of the hits, or constants that are wrong by 5 %, drawn at random. ``python
table.py -i runs -o out`` prints each case and writes ``cases.json``, ``table.md`` and ``table.rst`` (median and range
over the seeds of each geometry), and ``sections.png``; with ``--half-angle 20`` and ``--only`` rows of a narrower view.
"""

import argparse
import json
import re
from pathlib import Path

import numpy as np
import runs
import scipy

import apt_evap as ae

RADIUS, COMPRESSION = 12.963, 1.0342  # fitted to the sites of the pure run, R = 12 nm
EFFICIENCY, HALF_ANGLE, DISTANCE = 0.5, 30.0, 100.0
CONTRASTS = {"solute": 0.4, "20/2 %": 0.2, "6/2 %": 0.06}  # content of the phases, 2 % in the matrix
GEOMETRIES = {
    "pure": "pure", "sphere_low": "sphere, 0.8", "sphere_high": "sphere, 1.2", "layer_high": "layer, 1.15",
    "two_spheres": "two small spheres, 0.8 and 1.2", "layer_low-shank10": "layer, 0.85, shank of 10°",
    "layer40_high": "layer at 40°, 1.15", "layer40_low": "layer at 40°, 0.85", "sphere_edge": "sphere at the rim, 0.85",
    "core_shell": "shell of 1.15 and core of 0.85", "alloy_sphere": "sphere of 40 % in 2 %",
    "sphere_small-R20": "sphere, 0.8, R = 20 nm", "sphere_small-R30": "sphere, 0.8, R = 30 nm",
    "two_spheres-R20": "two small spheres, 0.8 and 1.2, R = 20 nm", "sphere_low@70": "sphere, 0.7",
    "sphere_low@90": "sphere, 0.9",
    "sphere_high-rolled (metal)": "sphere, 1.2, rolling of aluminium",
    "sphere_high-rolled (all)": "sphere, 1.2, all ions roll", "grains": "two grains",
}  # fmt: skip
GEOMETRIES |= {
    f"{name} ({angle}°)": f"{GEOMETRIES[name]}, half angle of {angle}°"
    for angle in (20, 25)
    for name in ("pure", "sphere_low", "sphere_high", "layer_high", "two_spheres", "core_shell")
}
GEOMETRIES |= {
    f"{name}-axis{axis}": f"{GEOMETRIES[name]}, axis [{axis}]"
    for axis in ("111", "001", "011", "113", "122")
    for name in ("sphere_low", "sphere_low@70", "sphere_low@90", "sphere_high", "core_shell")
}
PHASE_FIELDS = {
    "sphere_low": [0.8], "sphere_low@70": [0.7], "sphere_low@90": [0.9], "sphere_small": [0.8],
    "sphere_low_off": [0.8], "sphere_high": [1.2], "sphere_edge": [0.85], "layer_high": [1.15],
    "layer_low": [0.85], "layer40_high": [1.15], "layer40_low": [0.85], "two_spheres": [0.8, 1.2],
    "core_shell": [1.15, 0.85], "pure": [], "grains": [1.0],
}  # fmt: skip
PARTS = {"core_shell": ("shell", "core")}
EXACT = dict.fromkeys(("compression", "radius", "efficiency"), 0.0)
DRAWS = 2  # of wrong constants, for each seed


def detected(path, emission="rest", way="labels", half_angle=HALF_ANGLE, seed=7):
    """Ions that the detector recorded: hits with a voltage and solutes that are drawn, sites and phases."""
    kept = np.load(path)
    places = kept[emission].astype(float)
    rho = np.hypot(*places.T)
    rng = np.random.default_rng(seed)
    rows = np.isfinite(rho) & (rho < DISTANCE * np.tan(np.radians(half_angle)))
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


def reconstructed(hits, factors=(1.0, 1.0, 1.0), half_angle=HALF_ANGLE, **how):
    """Reconstruction with the constants of all cases, times factors of compression, radius and efficiency."""
    how = {name: how[name] * factors[1] if name in ("radius", "initial_radius") and how[name] != "shank" else how[name]
           for name in how}  # fmt: skip
    return ae.reconstruct(
        hits, atomic_volume=runs.VOLUME, distance=DISTANCE, detector_radius=DISTANCE * np.tan(np.radians(half_angle)),
        efficiency=EFFICIENCY * factors[2], projection="compressed", compression=COMPRESSION * factors[0], **how,
    )  # fmt: skip


def constants_of_map(hits, half_angle, growth, how):
    """Constants by the crystal, from 0.9 of the right radius: factors of ours, and their relative covariances."""
    name = "initial_radius" if "initial_radius" in growth else "radius"
    known = {key: value for key, value in how.items() if key != "half_angle"} | {name: 0.9 * growth[name]}
    found = ae.fit.constants_of_crystal(
        hits, element=runs.ALUMINIUM, distance=DISTANCE, detector_radius=DISTANCE * np.tan(np.radians(half_angle)),
        efficiency=EFFICIENCY, efficiency_error=0.0, **known,
    )  # fmt: skip
    factors = found.constants["compression"] / COMPRESSION, found.constants[name] / growth[name], 1.0
    return factors, found.covariance


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
        return {"volume": ()}
    if base == "grains":
        return {"volume": (), "labels": None}
    if base == "alloy_sphere":
        return {"labels": None, "solute": ("Cu",)}
    ways = {"labels": None}
    if emission == "rest":
        ways |= dict.fromkeys(CONTRASTS, ("Cu",))
        ways |= {"noisy voltage": None, "jump and restart": None, "constants of the map": None, "wrong constants": None}
    if base == "two_spheres":
        ways["two solutes"] = ("Cu", "Mg")
    return ways


def judged(found, truth, errors=EXACT):
    """Row of a reconstruction: what was measured, and how often its intervals hold the truth by errors of constants."""
    sites, phase, regions = truth
    row = measured(found, sites, phase, regions)
    if isinstance(found, ae.reconstruction.EvolvingReconstruction):
        row["verdict"], row["fields"] = found.verdict, [(one.ratio, one.error) for one in found.phases]
        if found.history is not None:
            row["coverage"] = coverage(found, sites, errors)
    return row


def compare(path, emission="rest", chosen=None, twin=None, half_angle=HALF_ANGLE):
    """One case by all methods, or by some, and with a twin: lists of rows of the table."""
    name = path.stem.rsplit("_", 1)[0]
    base = name.split("-")[0]
    phases, shank, _, apex, _ = runs.case(name)
    regions = [one.region for one in phases[1:]]
    radius = RADIUS * apex / runs.R
    growth = {"radius": radius, "half_angle": half_angle}
    if shank > 1.5:
        growth |= {"radius": "shank", "initial_radius": radius, "shank_angle": shank}
    hits, sites, phase = detected(path, emission, half_angle=half_angle)
    rows = {"cap": [judged(reconstructed(hits, **growth), (sites, phase, regions))]}
    rng = np.random.default_rng(sum(map(ord, path.stem)))
    for way, solutes in ways_of(base, emission, regions).items():
        if chosen and way not in chosen:
            continue
        hits, sites, phase = detected(path, emission, way, half_angle)
        truth = sites, phase, regions
        how = {"shape": "evolving"} | growth | ({"labels": phase} if solutes is None else {"solutes": solutes})
        if way == "wrong constants":
            draws = 1 + 0.05 * rng.normal(size=(DRAWS, 3))
            rows["cap, wrong constants"] = [judged(reconstructed(hits, each, **growth), truth) for each in draws]
            rows[way] = [judged(reconstructed(hits, each, **how), truth, None) for each in draws]
            continue
        factors, errors = (1.0, 1.0, 1.0), EXACT
        if way == "constants of the map":
            try:
                factors, errors = constants_of_map(hits, half_angle, growth, how)
            except ValueError as error:  # such as no pole in a narrow view
                print(f"{path.stem}, {way}: {error}", flush=True)
                continue
        rows[way] = [judged(reconstructed(hits, factors, **how), truth, errors)]
        if twin is not None and way in ("labels", "volume"):
            rows[f"{way}, twin"] = [judged(reconstructed(hits, twin=twin, **how), truth)]
    true = PHASE_FIELDS.get(base, [])
    view = "" if half_angle == HALF_ANGLE else f" ({half_angle:g}°)"
    return {"name": path.stem + ("" if emission == "rest" else f" ({emission})") + view, "true": true, "rows": rows}


def over(values, digits=2):
    """Median and range of values, as text."""
    values = np.asarray(values, float)
    if len(values) < 2:
        return f"{values[0]:.{digits}f}" if len(values) else ""
    return f"{np.median(values):.{digits}f} ({values.min():.{digits}f} to {values.max():.{digits}f})"


def lines_of(geometry, way, rows, of):
    """Lines of the table of one method, one for each phase."""
    followed = [row for row in rows if not row.get("verdict", "").startswith("cap")]
    of += f", {len(rows) - len(followed)} left to the cap" if len(followed) < len(rows) else ""
    label, parts = GEOMETRIES[geometry], PARTS.get(geometry.split(" (")[0], ("first", "second"))
    if not followed:
        yield [f"{label}, {of}", way, *[""] * 7]
        return
    held = [row["coverage"] for row in followed if "coverage" in row]
    n = len(followed[0]["phases"])
    for k in range(max(n, 1)):
        line = [label + (f": {parts[k]}" if n > 1 else "") + f", {of}", way]
        line += [over([row[side] for row in followed], 3) if k == 0 else "" for side in ("lateral", "depth")]
        each = [row["phases"][k] for row in followed if row["phases"]]
        line.append(" / ".join(filter(None, (over([one[side] for one in each]) for side in ("wide", "thick")))))
        line += [over([one[what] for one in each]) for what in ("density", "wrong")]
        fields = [row["fields"][k] for row in followed if len(row.get("fields", [])) > k]
        fields = [one for one in fields if np.isfinite(one[1])]  # else no contrast was seen
        errors = f" ± {np.median([error for _, error in fields]):.3f}" if fields else ""
        line.append(over([ratio for ratio, _ in fields], 3) + errors)
        line.append(" / ".join(f"{part:.2f}" for part in np.mean(held, axis=0)) if held and k == 0 else "")
        yield line


def table_of(cases):
    """Lines of the table: the seeds of each geometry by each method."""
    for geometry in GEOMETRIES:
        seeds = [case for name, case in cases.items() if re.sub(r"_\d+", "", name) == geometry]
        for way in dict.fromkeys(way for case in seeds for way in case["rows"]):
            parts = [case["rows"][way] for case in seeds if way in case["rows"]]
            of = f"{len(parts)} seed{'s' * (len(parts) > 1)}"
            if len(parts[0]) > 1:
                of += f" of {len(parts[0])} draws"
            yield from lines_of(geometry, way, [row for part in parts for row in part], of)


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
    parser.add_argument("--half-angle", type=float, default=HALF_ANGLE, help="degrees; default: 30")
    options = parser.parse_args()
    twin = None if options.twin is None else ae.load(options.twin)
    kept = options.output / "cases.json"
    cases = json.loads(kept.read_text()) if options.only and kept.exists() else {}
    paths = sorted(options.input.glob("*.npz"))
    for path in paths:
        if options.only and path.stem not in options.only:
            continue
        for emission in ("rest", "metal", "all") if "-rolled" in path.stem else ("rest",):
            case = compare(path, emission, options.ways, twin, options.half_angle)
            case["rows"] = cases.get(case["name"], case)["rows"] | case["rows"]
            cases[case["name"]] = case
            for line in table_of({case["name"]: case}):
                print(" | ".join(line), flush=True)
            kept.write_text(json.dumps(cases, indent=1, default=float))
    header = ["case, field", "method", "lateral [nm]", "depth [nm]", "width / thickness", "density", "wrong side",
              "field found", "coverage"]  # fmt: skip
    lines = [header, *table_of(cases)]
    table = [f"| {' | '.join(line)} |" for line in lines]
    table.insert(1, "|---" * len(header) + "|")
    (options.output / "table.md").write_text("\n".join(table) + "\n")
    table = [".. csv-table::", "   :header-rows: 1", "   :delim: |", ""]
    table += ["   " + " | ".join(line).rstrip() for line in lines]
    (options.output / "table.rst").write_text("\n".join(table) + "\n")
    if not options.only:
        chosen = [path for path in paths if path.stem in ("layer_high_1", "sphere_low_1")]
        draw(chosen, options.output)


if __name__ == "__main__":
    main()
