"""Answers by the methods of this package, and by two others: ``python baselines.py FOLDER [NAME ...]``.

Reads ``measured`` only, and writes ``answers/cap`` and ``answers/evolving``. With ``--program apyt`` the positions of
this package are written instead, with the radius and the compression of ``answers/cap``; with ``--program pyccapt`` the
clusters that it finds in the positions of ``answers/cap``. Run both by the Python that has the package.
"""

import argparse
import json
import time
import warnings
from pathlib import Path

import h5py
import numpy as np

FIELD_FACTOR = 3.3  # of the literature; those of the specimens are 2.8 to 3.8
STEP = 0.1  # nm, of profiles


def read(path):
    """Columns and attributes of a measurement."""
    with h5py.File(path) as file:
        return {name: file[name][()] for name in file}, dict(file.attrs)


def common(given):
    """Constants of a reconstruction that are given."""
    rim = given["field_of_view"] / 2
    named = {name: float(given[name]) for name in ("distance", "efficiency", "atomic_volume")}
    return named | {"detector_radius": float(rim), "projection": "compressed"}


def orientation(hits, given):
    """What `index` finds on a map of the angles of flight: the result, and the image compression of the whole view."""
    import apt_evap as ae

    distance = float(given["distance"])
    across = np.hypot(hits.x, hits.y)
    flat = distance * np.arctan(across / distance) / np.maximum(across, 1e-9)  # angles of flight in place of a plane
    hits = ae.Hits(x=flat * hits.x, y=flat * hits.y)
    found = ae.index(hits, given["material"], scales=(distance / 1.3, distance / 0.95))
    if not found.candidates:
        return found, 1.0
    return found, distance / (found.best.projection.scale * (1 + found.best.rim_change))


def normal_of_layers(positions, marked, tilts):
    """Direction along which the fraction of the solute varies most beyond chance."""
    points = positions - positions.mean(axis=0)
    best, chosen = -np.inf, None
    for tilt in np.radians(tilts):
        for turn in np.radians(np.arange(0, 360, max(3, 3 / max(np.sin(tilt), 0.1)))):
            normal = np.array((np.sin(tilt) * np.cos(turn), np.sin(tilt) * np.sin(turn), np.cos(tilt)))
            bins = np.floor((points @ normal) / STEP).astype(int)
            bins -= bins.min()
            ions, solutes = np.bincount(bins), np.bincount(bins, marked)
            full = ions > 20
            score = (solutes[full] ** 2 / ions[full]).sum() - np.count_nonzero(full) * marked.mean()
            if score > best:
                best, chosen = score, normal
    return chosen


def layers(cloud, solute):
    """Thickness, spacing and shares of layers by a profile along their normal."""
    marked = cloud.mark(solute).astype(float)
    profile = cloud.profile(normal_of_layers(cloud.positions, marked, np.arange(0, 75, 3)), STEP).of(solute)
    full = profile.ions > 20
    fraction, places = profile.fraction[full], profile.centres[full]
    base, top = np.quantile(fraction, 0.2), np.sort(fraction)[-4:].mean()
    above = fraction > (base + top) / 2
    starts = np.flatnonzero(np.diff(np.r_[False, above].astype(int)) == 1)
    ends = np.flatnonzero(np.diff(np.r_[above, False].astype(int)) == -1) + 1
    cuts = [slice(a, b) for a, b in zip(starts, ends, strict=True) if b - a > 1]
    if not cuts:
        return {}
    thickness = np.sum(np.clip(fraction - base, 0, None)) / (top - base) * STEP / len(cuts)
    middles = [np.average(places[cut], weights=fraction[cut]) for cut in cuts]
    answers = {"thickness": (thickness, np.nan), f"{solute} of phase": (100 * top, np.nan)}
    answers[f"{solute} of matrix"] = (100 * base, np.nan)
    return answers | ({"spacing": (float(np.mean(np.diff(middles))), np.nan)} if len(cuts) > 1 else {})


def boundary(cloud, solute, given):
    """Excess of a boundary whose normal is found; its area is that of the atoms about it."""
    import apt_evap as ae

    marked = cloud.mark(solute)
    normal = normal_of_layers(cloud.positions, marked.astype(float), np.arange(60, 91, 3))
    along = (cloud.positions - cloud.positions.mean(axis=0)) @ normal
    ions, edges = np.histogram(along, np.arange(along.min(), along.max(), STEP))
    solutes = np.histogram(along[marked], edges)[0]
    middle = edges[np.argmax(np.convolve(np.where(ions > 20, solutes / np.maximum(ions, 1), 0), np.ones(5), "same"))]
    distances, window = along - middle, 1.2
    atoms = np.count_nonzero(np.abs(distances) <= window) / float(given["efficiency"])
    area = atoms * float(given["atomic_volume"]) / (2 * window)
    excess = ae.measures.interfacial_excess(distances, marked, area, window, 3.0, float(given["efficiency"]))
    return {"excess": excess}


def ellipsoids(clusters):
    """Ions in the uniform ellipsoids that have the centres and covariances of the solutes of clusters.

    Envelope and erosion keep the solvent that is near solutes only: of a true sphere with 37 % they find 60 %.
    """
    positions, inside = clusters.cloud.positions, np.zeros(len(clusters.cloud), bool)
    for number, centre in enumerate(clusters.centres):
        covariance = np.cov(positions[clusters.members == number].T) + 1e-4 * np.eye(3)
        away = positions - centre
        inside |= np.einsum("ni,ij,nj->n", away, np.linalg.inv(covariance), away) < 5
    return inside


def shell_about(cloud, clusters, shell):
    """Thickness of a shell about the largest cluster [nm], and the ions between it and the cluster."""
    around, inner = np.linalg.norm(cloud.positions - clusters.centres[0], axis=1), float(clusters.radii[0])
    # outer radius of a shell of uniform density with this mean square
    square = np.mean(around[cloud.mark(shell) & (around < 3 * inner)] ** 2)
    outer = np.linspace(inner + 0.01, 4 * inner + 0.02, 2000)
    of = 0.6 * (outer**5 - inner**5) / (outer**3 - inner**3)
    thickness = float(np.interp(square, of, outer)) - inner
    return thickness, (around > inner) & (around < inner + thickness) & ~ellipsoids(clusters)


def precipitates(cloud, given):
    """Number, radius and shares by clusters whose d_max is chosen against random labels."""
    solute = given["solute"]
    clusters = cloud.clusters(solute)
    answers, shares, rich = {"number": (float(len(clusters)), np.nan)}, {}, ellipsoids(clusters)
    outside = (clusters.labels < 0) & ~rich
    if len(clusters):
        answers["radius"] = (float(clusters.radii.mean()), np.nan)
        shares["phase"] = cloud.select(rich).fractions()
    if (shell := given["shell"]) and len(clusters):
        thickness, inside = shell_about(cloud, clusters, shell)
        answers["shell thickness"] = (thickness, np.nan)
        shares["shell"] = cloud.select(inside).fractions()
        outside &= ~inside
    shares["matrix"] = cloud.select(outside).fractions()
    for phase, part in shares.items():
        for element, (share, error) in part.items():
            answers[f"{element} of {phase}"] = (100 * share, 100 * error)
    return answers


def structure(cloud, given):
    """Answers about composition and structure."""
    if given["structure"] == "layers":
        return layers(cloud, given["solute"])
    return boundary(cloud, given["solute"], given) if given["structure"] == "boundary" else precipitates(cloud, given)


def write(path, answers, positions, asked):
    """Write the answers to what is asked for."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with h5py.File(path, "w") as file:
        for quantity, (value, error) in answers.items():
            if (quantity in asked or quantity.startswith("axis ")) and np.isfinite(value):
                file[quantity] = [value, error]
        if positions is not None:
            file["positions"] = positions.astype(np.float32)


def axis_of(candidate):
    """Crystal direction at the centre of the detector, where the axis of a specimen is seen; not that of the ions."""
    return (candidate.projection.directions(np.zeros((1, 2))) @ candidate.orientation.matrix)[0]


def by_this_package(folder, name):
    """Answers of the cap and of the evolving surface, both with constants that are found."""
    import apt_evap as ae

    warnings.simplefilter("ignore", ae.warnings.AptWarning)  # no clusters, or the cap in place of the surface
    columns, given = read(folder / "measured" / f"{name}.h5")
    asked, start = json.loads(given["questions"]), time.process_time()
    hits = ae.Hits(x=columns["x"], y=columns["y"], voltage=columns["voltage"],
                   extra={"element": columns["element"].astype(str)})  # fmt: skip
    found, compression = orientation(hits, given)
    radius = float(np.median(columns["voltage"])) / (FIELD_FACTOR * float(given["evaporation_field"]))
    solutes = [solute for solute in (given["solute"], given["shell"]) if solute]
    known, said = common(given) | {"radius": radius, "compression": compression}, "no orientation"
    answers = {name: (value, np.nan) for name, value in (("apex radius", radius), ("compression", compression))}
    if found.candidates:
        material = ae.material(given["material"], a=float(given["a"]))
        try:
            crystal = ae.fit.constants_of_crystal(
                hits, element=material, orientation=found.best.orientation, efficiency_error=0.0, shape="evolving",
                solutes=solutes, **known,
            )  # fmt: skip
        except ValueError as error:
            said = str(error)
        else:
            known, said = known | crystal.constants, str(crystal)
            errors = np.sqrt(np.diag(crystal.covariance)) * (known["compression"], known["radius"], 1)
            answers = {"apex radius": (known["radius"], errors[1]), "compression": (compression, errors[0])}
    if found.decided and "axis" in asked:
        axis = axis_of(found.best)
        answers |= {f"axis {index}": (value, np.nan) for index, value in zip("hkl", axis, strict=True)}
    for method, options in (("cap", {}), ("evolving", {"shape": "evolving", "solutes": solutes})):
        volume = ae.reconstruct(hits, **known, **options)
        cloud = ae.measures.PointCloud.of(volume.hits, positions=volume.specimen_positions)
        measured = structure(cloud, given)
        write(folder / "answers" / method / f"{name}.h5", answers | measured, volume.specimen_positions, asked)
    seconds = time.process_time() - start
    print(f"{name}: {found.verdict}, {said}; {volume.verdict}; {seconds:.0f} s of processor", flush=True)


def by_pyccapt(folder, name):
    """Number and radius of clusters by pyccapt, with the d_max that it estimates, of the positions of our cap."""
    from pyccapt.calibration.clustering import clustering

    columns, given = read(folder / "measured" / f"{name}.h5")
    with h5py.File(folder / "answers" / "cap" / f"{name}.h5") as file:
        points = file["positions"][()][columns["element"] == given["solute"].encode()]
    separation = clustering.estimate_maximum_separation_distance(points)
    labels, centres = clustering.maximum_separation_clustering(points, d_max=separation, n_min=10)
    answers = {"number": (float(len(centres)), np.nan)}
    if len(centres):
        squares = [points[labels == one].var(axis=0).sum() for one in range(len(centres))]
        answers["radius"] = (float(np.sqrt(5 / 3 * np.array(squares)).mean()), np.nan)
    write(folder / "answers" / "pyccapt" / f"{name}.h5", answers, None, json.loads(given["questions"]))


def by_apyt(folder, name):
    """Positions by the classic geometry of APyT, with the constants of our cap."""
    from apyt.reconstruction.basic import get_geometry_classic, reconstruct

    columns, given = read(folder / "measured" / f"{name}.h5")
    with h5py.File(folder / "answers" / "cap" / f"{name}.h5") as file:
        radius, compression = (float(file[quantity][0]) for quantity in ("apex radius", "compression"))
    distance, rim = float(given["distance"]), float(given["field_of_view"] / 2)
    compression *= distance / rim * np.arctan(rim / distance)  # theirs is the angle over the tangent
    radii = np.full(len(columns["x"]), radius)
    volumes = np.full(len(radii), float(given["atomic_volume"] / given["efficiency"]))
    depths, radii = get_geometry_classic(volumes, radii, compression * rim / distance)
    positions = reconstruct(np.column_stack([columns["x"], columns["y"]]), depths, radii, distance, compression)
    write(folder / "answers" / "apyt" / f"{name}.h5", {}, positions * (1, 1, -1), [])


METHODS = {None: by_this_package, "pyccapt": by_pyccapt, "apyt": by_apyt}


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    parser.add_argument("names", nargs="*", help="specimens; default: all that are measured")
    parser.add_argument("--program", choices=("pyccapt", "apyt"), help="another package")
    options = parser.parse_args()
    for name in options.names or sorted(path.stem for path in (options.folder / "measured").glob("*.h5")):
        METHODS[options.program](options.folder, name)


if __name__ == "__main__":
    main()
