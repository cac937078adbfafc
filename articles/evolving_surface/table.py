"""
Cap and evolving surface beside the truth
=========================================

Reconstructs the runs of ``runs.py`` by the cap and by a surface that follows the ions, with the true phase of each ion
and with the local composition of a solute, and compares both with the true sites: errors, sizes, densities, ions on the
wrong side of an interface, evaporation fields, and how often the intervals of the positions hold the truth. Radius and
compression are those that fit the run of pure aluminium; the efficiency is known. ``python table.py -i runs -o out``
prints the table and writes ``table.rst`` and ``sections.png``.
"""

import argparse
import time
from pathlib import Path

import numpy as np
import runs
import scipy

import apt_evap as ae

RADIUS, COMPRESSION = 12.963, 1.0342  # fitted to the sites of the pure run
EFFICIENCY, HALF_ANGLE, DISTANCE = 0.5, 30.0, 100.0
SHARES = (0.02, 0.4, 0.1)  # of a solute in the matrix and in the phases
CHOSEN_ON = ("pure_1", "sphere_low_rolled_1", "layer_high_rolled_1", "layer40_high_1")
PHASE_FIELDS = {
    "sphere_low": [0.8], "sphere_low_off": [0.8], "sphere_high": [1.2], "sphere_edge": [0.85], "layer_high": [1.15],
    "layer_low": [0.85], "layer40_high": [1.15], "layer40_low": [0.85], "two_spheres": [0.8, 1.2],
    "core_shell": [1.15, 0.85], "pure": [],
}  # fmt: skip


def detected(path, emission="rest", seed=7):
    """Ions that the detector recorded: hits with a voltage and a solute that is drawn, sites and phases."""
    kept = np.load(path)
    places = kept[emission].astype(float)
    rho = np.hypot(*places.T)
    rng = np.random.default_rng(seed)
    rows = np.isfinite(rho) & (rho < DISTANCE * np.tan(np.radians(HALF_ANGLE)))
    rows &= rng.random(len(rows)) < EFFICIENCY
    # the voltage of a rate that is controlled: that of the sites, averaged over 0.15 nm of 8.4 nm
    voltage = scipy.ndimage.gaussian_filter1d(kept["voltage"], 0.15 / 8.4 * len(rows), mode="nearest")
    phase = kept["phase"].astype(int)
    solute = rng.random(len(phase)) < np.array(SHARES)[np.minimum(phase, 2)]
    if path.stem.startswith("alloy"):  # in the others the species is that of the phase
        solute = kept["species"] > 0
    element = np.where(solute, "Cu", "Al")
    hits = ae.Hits(x=places[rows, 0], y=places[rows, 1], voltage=voltage[rows], extra={"element": element[rows]})
    return hits, kept["sites"][rows], phase[rows]


def reconstructed(hits, **how):
    """Reconstruction with the constants of all cases."""
    return ae.reconstruct(
        hits, atomic_volume=runs.VOLUME, distance=DISTANCE, detector_radius=DISTANCE * np.tan(np.radians(HALF_ANGLE)),
        efficiency=EFFICIENCY, projection="compressed", compression=COMPRESSION, **how,
    )  # fmt: skip


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


def coverage(found, sites):
    """Part of the ions whose true site is within 1 and 2 standard deviations, lateral and in depth."""
    covariances = ae.reconstruction.position_covariances(found)
    errors = found.specimen_positions - sites
    ratio = np.abs(errors - errors.mean(axis=0)) / np.sqrt(np.einsum("nii->ni", covariances))
    return [float((part < sigmas).mean()) for sigmas in (1, 2) for part in (ratio[:, :2], ratio[:, 2])]


def compare(path, emission="rest"):
    """One case by all methods: rows of the table."""
    name = path.stem.rsplit("_", 1)[0]
    base = name.removesuffix("_rolled").removesuffix("_shank")
    hits, sites, phase = detected(path, emission)
    regions = [one.region for one in runs.case(name)[0][1:]]
    growth = {"radius": RADIUS}
    if name.endswith("_shank"):
        growth = {"radius": "shank", "initial_radius": RADIUS, "shank_angle": 6.0}
    rows = {"cap": measured(reconstructed(hits, **growth), sites, phase, regions)}
    ways = {"labels": {"labels": phase}, "solute": {"solutes": ("Cu",)}} if regions else {"ring": {}}
    if emission != "rest":
        del ways["solute"]
    for way, how in ways.items():
        start = time.process_time()
        found = reconstructed(hits, shape="evolving", **growth, **how)
        row = measured(found, sites, phase, regions)
        row["seconds"] = time.process_time() - start
        row["verdict"], row["fields"] = found.verdict, [(one.ratio, one.error) for one in found.phases]
        if emission == "rest" and found.history is not None and way != "solute":
            row["coverage"] = coverage(found, sites)
        rows[way] = row
    true = PHASE_FIELDS.get(base, [])
    return {"name": path.stem + ("" if emission == "rest" else f" ({emission})"), "true": true, "rows": rows}


def lines_of(case):
    """Lines of the table, one for each method."""
    for way, row in case["rows"].items():
        phases = "; ".join(
            f"{one['wide']:.2f} / {one['thick']:.2f}, {one['density']:.2f}, {one['wrong']:.2f}" for one in row["phases"]
        )
        fields = "; ".join(f"{ratio:.3f} ± {error:.3f}" for ratio, error in row.get("fields", []))
        held = " / ".join(f"{part:.2f}" for part in row.get("coverage", []))
        errors = f"{row['lateral']:.3f} / {row['depth']:.3f}"
        yield [case["name"], way, errors, phases, fields, held], row.get("verdict", "")


def draw(paths, output):
    """Sections through true sites, cap and evolving surface, and what the model measured."""
    figure = ae.plot.new_figure((13.0, 3.3 * len(paths)))
    figure.set_layout_engine("constrained")
    panels = figure.subplots(len(paths), 4, squeeze=False)
    for axes, path in zip(panels, paths, strict=True):
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
        axes[3].set(xlabel="depth of the apex [nm]", ylim=(0.3, 2.0))
        axes[3].legend(fontsize="small")
        axes[0].set_title(f"{path.stem}: true sites")
    figure.savefig(output / "sections.png", dpi=110)


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("-i", "--input", type=Path, default=Path("runs"), help="folder of the runs; default: runs")
    parser.add_argument("-o", "--output", type=Path, default=Path(), help="folder of table and picture")
    options = parser.parse_args()
    paths = sorted(options.input.glob("*.npz"))
    table = [".. list-table::\n   :header-rows: 1\n"]
    header = ["case", "method", "lateral / depth [nm]", "width / thickness, density, wrong side", "field", "coverage"]
    table.append("   * - " + "\n     - ".join(header))
    for path in sorted(paths, key=lambda path: path.stem not in CHOSEN_ON):
        for emission in ("rest", "metal", "all") if "_rolled" in path.stem else ("rest",):
            for row, verdict in lines_of(compare(path, emission)):
                print(" | ".join(row), "|", verdict, flush=True)
                table.append("   * - " + "\n     - ".join(row))
    (options.output / "table.rst").write_text("\n".join(table) + "\n")
    draw(
        [path for path in paths if path.stem.startswith(("sphere_low_r", "layer_high_r", "layer40_high"))],
        options.output,
    )


if __name__ == "__main__":
    main()
