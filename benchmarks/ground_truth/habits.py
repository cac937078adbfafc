"""Measures of all sites, of the recorded ions at their sites, and of their reconstructions: ``habits.py FOLDER``.

Constants are those that fit the sites best, so that detection and trajectories remain. Prints each specimen, and how
far each usual d_max and isoconcentration is moved, the worst one first.
"""

import sys
import warnings
from pathlib import Path

import h5py
import numpy as np
from baselines import common, read
from score import read_truth

import apt_evap as ae

SEPARATIONS = (0.4, 0.5, 0.6, 0.7, 0.8)  # nm
FEWEST = 10
SHARES = (0.05, 0.1, 0.2, 0.3)
WAYS = ("all sites", "recorded", "cap", "evolving")


def clouds(folder, name):
    """Point clouds of a specimen by `WAYS`, in its coordinates."""
    columns, given = read(folder / "measured" / f"{name}.h5")
    answers, sites, _ = read_truth(folder / "truth" / f"{name}.h5")
    hits = ae.Hits(x=columns["x"], y=columns["y"], voltage=columns["voltage"], positions=sites,
                   extra={"element": columns["element"].astype(str)})  # fmt: skip
    recorded = ae.measures.PointCloud.of(hits)
    with h5py.File(folder / "truth" / f"{name}.h5") as file:
        everything = ae.Hits(
            positions=file["all_positions"][()], extra={"element": file["all_elements"][()].astype(str)}
        )
    parts = [ae.measures.PointCloud.of(everything).select(recorded.hull), recorded]
    known = common(given) | {"radius": answers["apex radius"], "compression": answers["compression"]}
    solutes = [solute for solute in (given["solute"], given["shell"]) if solute]
    for options in ({}, {"shape": "evolving", "solutes": solutes}):
        volume = ae.reconstruct(hits, **known, **options)
        placed = volume.fitted_positions(sites, ("shift", "rotation"))
        parts.append(ae.measures.PointCloud.of(volume.hits, positions=placed))
    return dict(zip(WAYS, parts, strict=True)), given["solute"]


def measures(cloud, solute):
    """Clusters by each d_max, and volume above each isoconcentration [nm^3]."""
    values = {}
    for separation in SEPARATIONS:
        clusters = cloud.clusters(solute, separation, FEWEST)
        values[f"clusters, d_max {separation}"] = float(len(clusters))
        values[f"solutes in clusters, d_max {separation}"] = clusters.clustered_fraction
        values[f"radius, d_max {separation}"] = float(clusters.radii.mean()) if len(clusters) else np.nan
    field = cloud.field(solute)
    for share in SHARES:
        inside = field.filled() & (np.nan_to_num(field.fraction) > share)
        values[f"volume, {100 * share:.0f} %"] = np.count_nonzero(inside) * field.voxel**3
    return values


def main(folder):
    warnings.simplefilter("ignore", ae.warnings.AptWarning)
    table = {}
    for path in sorted((folder / "measured").glob("*.h5")):
        parts, solute = clouds(folder, path.stem)
        table[path.stem] = {way: measures(cloud, solute) for way, cloud in parts.items()}
        print(path.stem, {way: len(cloud) for way, cloud in parts.items()}, flush=True)
        for name in next(iter(table[path.stem].values())):
            row = [table[path.stem][way][name] for way in WAYS]
            print(f"  {name:36}" + "".join(f"{value:10.3g}" for value in row))
    print("RMS of ln(reconstruction / all sites), of the specimens with a structure; lost: nothing was found")
    rows = []
    for name in next(iter(next(iter(table.values())).values())):
        kinds = ("precipitates", "core", "layers") if name.startswith("volume") else ("precipitates", "core")
        with_structure = [one for one in table if one.startswith(kinds)]
        cells = []
        for way in WAYS[1:]:
            pairs = np.array([(table[one][way][name], table[one][WAYS[0]][name]) for one in with_structure])
            known = (pairs > 0).all(axis=1)
            size = np.sqrt(np.mean(np.log(pairs[known, 0] / pairs[known, 1]) ** 2)) if known.any() else np.nan
            cells.append((size, int(((pairs[:, 1] > 0) & ~(pairs[:, 0] > 0)).sum())))
        rows.append((name, cells))
    for name, cells in sorted(rows, key=lambda row: (row[0].split(",")[0], -row[1][1][0])):
        print(f"  {name:36}" + "".join(f"{size:10.2f} ({lost} lost)" for size, lost in cells))


if __name__ == "__main__":
    main(Path(sys.argv[1]))
