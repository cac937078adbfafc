"""Usual measures of all sites, of the recorded ions at their sites, and of reconstructions: ``habits.py FOLDER``.

Constants of the reconstructions are those that fit the sites best, so that detection and trajectories remain. Prints
each specimen beside its truth, and the error of each usual d_max and isoconcentration.
"""

import sys
import warnings
from pathlib import Path

import h5py
import numpy as np
from baselines import STEP, boundary, common, normal_of_layers, read
from score import read_truth

import apt_evap as ae

SEPARATIONS = (0.4, 0.5, 0.6, 0.7, 0.8)  # nm
FEWEST = 10
SHARES = (0.05, 0.1, 0.2, 0.3)
WAYS = ("all sites", "recorded", "cap", "evolving")


def clouds(folder, name):
    """Point clouds of a specimen by `WAYS`, in its coordinates, what is given, and the answers."""
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
    return dict(zip(WAYS, parts, strict=True)), given, answers


def measures(cloud, given, answers):
    """Values by measure and setting, and the truth of each; 0 for what is not found."""
    solute, values = given["solute"], {}
    if "number" in answers:
        for separation in SEPARATIONS:
            clusters = cloud.clusters(solute, separation, FEWEST)
            if answers["number"]:
                size = float(clusters.radii.mean()) if len(clusters) else 0.0
                values["number of clusters", separation] = float(len(clusters)), answers["number"]
                values["radius of clusters", separation] = size, answers["radius"]
                true, atoms = answers[f"{solute} of phase"], clusters.atoms.sum(axis=0)
                every = 100 * atoms[cloud.elements.index(solute)] / max(atoms.sum(), 1)
                values["solute of all ions after erosion", separation] = every, true  # by d_max, as the envelope
                held_out = 100 * np.nan_to_num(clusters.fractions()[solute][0])
                values["solute without those that chose", separation] = held_out, true
            else:
                values["clusters of a random alloy", separation] = float(len(clusters)), 0.0
    if answers.get("number"):
        field = cloud.field(solute)
        for share in SHARES:
            inside = field.filled() & (np.nan_to_num(field.fraction) > share)
            each = np.count_nonzero(inside) * field.voxel**3 / answers["number"]
            values["radius by isoconcentration", share] = np.cbrt(3 * each / (4 * np.pi)), answers["radius"]
    if "thickness" in answers:
        marked = cloud.mark(solute).astype(float)
        normal = normal_of_layers(cloud.positions, marked, np.arange(0, 75, 3))
        profile = cloud.profile(normal, STEP).of(solute)
        for share in SHARES:
            above = (profile.ions > 20) & (np.nan_to_num(profile.fraction) > share)
            values["thickness by isoconcentration", share] = np.count_nonzero(above) * STEP / 2, answers["thickness"]
    if f"{solute} of phase" in answers:
        for share in SHARES:
            try:
                profile = cloud.proxigram(solute, share)
                inside = profile.atoms[profile.centres < 0].sum(axis=0)
                found = 100 * inside[profile.elements.index(solute)] / max(inside.sum(), 1)
            except ValueError:  # no such surface
                found = 0.0
            values["solute inside the isosurface", share] = found, answers[f"{solute} of phase"]
    if "excess" in answers:
        values["excess", ""] = boundary(cloud, solute, given)["excess"][0], answers["excess"]
    return values


def main(folder):
    warnings.simplefilter("ignore", ae.warnings.AptWarning)
    table = {}
    for path in sorted((folder / "measured").glob("*.h5")):
        parts, given, answers = clouds(folder, path.stem)
        table[path.stem] = {
            way: measures(cloud, given | ({"efficiency": 1.0} if way == "all sites" else {}), answers)
            for way, cloud in parts.items()
        }
        print(path.stem, {way: len(cloud) for way, cloud in parts.items()}, flush=True)
        for key, (_, true) in table[path.stem]["cap"].items():
            row = [table[path.stem][way][key][0] for way in WAYS]
            print(f"  {key[0]:34}{key[1]:<6}{true:10.3g}" + "".join(f"{value:10.3g}" for value in row))
    print(f"RMS of the relative error [%], or mean number of a random alloy:\n{'':50}{WAYS}")
    keys = dict.fromkeys(key for ways in table.values() for key in ways["cap"])
    for key in sorted(keys, key=str):
        of = [ways for ways in table.values() if key in ways["cap"]]
        cells = []
        for way in WAYS:
            found, true = np.array([ways[way][key] for ways in of]).T
            cells.append(100 * np.sqrt(np.mean((found / true - 1) ** 2)) if true.any() else found.mean())
        print(f"  {key[0]:34}{key[1]:<6}{len(of):6}" + "".join(f"{cell:10.3g}" for cell in cells))


if __name__ == "__main__":
    main(Path(sys.argv[1]))
