"""
The lens beside measured maps
=============================

Compares the lens of `apt_evap.detection.microscope` with a hit list of tungsten (voltages, one flight length), with the
poles of a map of nickel, and with the stored positions of a file of silicon::

    python measured.py W_tap.raw ni111_map.npz Si.epos

It takes a minute. The files are not distributed with this package.
"""

import argparse
from itertools import pairwise, product
from math import gcd

import numpy as np
import scipy

import apt_evap as ae

SHANKS = (1.0, 2.0, 3.0, 5.0, 8.0)
FLIGHT_LENGTH, SCALE = 305.0, 180.0  # of tungsten: mm, and mm/rad of its crystal
UNIT = 1.929706e-4  # 2 e in u mm^2 / (V ns^2)
SEEDS = {(1, 1, 1): (-9.6, -0.4), (1, 1, 3): (2.4, 6.2), (1, 3, 1): (-7.5, -13.5)}  # of nickel: mm
REACH = 1.0  # mm around a predicted pole in which its dark spot is looked for


def tungsten(path):
    """Radius and compression from the voltage, for shanks and evaporation fields."""
    hits = ae.read(path)
    x, y, time, voltage = hits.require("x", "y", "time_of_flight", "voltage")
    path_length = np.sqrt(FLIGHT_LENGTH**2 + x**2 + y**2)
    # times are late by a constant, which puts the largest peak at 183.84 / 3 u
    largest = np.abs(time - np.median(time)) < 30
    offset = np.median((time - path_length * np.sqrt(183.84 / 3 / UNIT / voltage))[largest])
    ratio = UNIT * voltage * ((time - offset) / path_length) ** 2
    print(f"offset of the times {offset:.1f} ns")
    voltage = voltage[(ratio > 59.0) & (ratio < 62.3)]
    low, middle, high = np.percentile(voltage, [0.5, 50, 99.5])
    print(f"{len(voltage)} ions of W3+, {low:.0f} to {high:.0f} V, median {middle:.0f} V")
    print(f"compression from the poles: {FLIGHT_LENGTH} / {SCALE:g} = {FLIGHT_LENGTH / SCALE:.2f}")
    for preset, field in product(("plane electrode", "local electrode"), (52.0, 57.0)):
        for shank in SHANKS:
            lens = ae.detection.LocalElectrode.preset(preset, shank_angle=shank)
            radius = float(lens.radius(middle, field))
            angles = np.array([5.0, 15.0, 30.0])
            places = FLIGHT_LENGTH * np.tan(np.radians(lens.projection(radius).flight_angles(angles)))
            print(
                f"{preset}, {field:g} V/nm, shank {shank:g} degrees: R {radius:.1f} nm, k_f "
                f"{lens.field_factor(radius):.2f}, xi {lens.compression(radius):.3f}; mm/rad at 5, 15, 30 degrees",
                np.round(places / np.radians(angles), 1),
            )
    for potential in (-4300.0, 4300.0, 10000.0):
        for shank in (3.0, 5.0):
            lens = ae.detection.LocalElectrode.preset(
                "plane electrode", shank_angle=shank, detector_potential=potential
            )
            radius = float(lens.radius(middle, 57.0))
            place = lens.distance_from_axis(15.0, radius, middle, FLIGHT_LENGTH)
            print(f"detector at {potential:g} V, shank {shank:g}: {place / np.radians(15.0):.1f} mm/rad at 15 degrees")


def spots(path, fit):
    """Centres of dark spots at the predicted places of low-index poles [mm], and their distances from these places."""
    measured = ae.io.read_map(path)
    density = np.asarray(measured.values, float)
    x, y = ((edges[1:] + edges[:-1]) / 2 for edges in (measured.x_edges, measured.y_edges))
    families = [(1, 1, 1), (0, 0, 1), (0, 1, 1), (1, 1, 3), (0, 1, 2), (1, 3, 3), (1, 1, 2)]
    allowed = {tuple(sorted(family)) for family in families}
    every = [hkl for hkl in product(range(-3, 4), repeat=3) if any(hkl) and gcd(*hkl) == 1]
    planes = np.array([hkl for hkl in every if tuple(sorted(map(abs, hkl))) in allowed])
    rotated = planes / np.linalg.norm(planes, axis=1)[:, None] @ fit.orientation.matrix.T
    planes, rotated = planes[rotated[:, 2] > 0.5], rotated[rotated[:, 2] > 0.5]
    predicted = fit.projection.places(rotated)
    grid_x, grid_y = np.meshgrid(x, y)
    found = []
    for hkl, place in zip(planes, predicted, strict=True):
        distance = np.hypot(grid_x - place[0], grid_y - place[1])
        inside = np.isfinite(density)
        near, ring = (distance < REACH) & inside, (distance > 1.5 * REACH) & (distance < 3 * REACH) & inside
        around = (distance > 1.5 * REACH) & (distance < 3 * REACH)
        if not near.any() or near.sum() < 0.9 * np.pi * (REACH / 0.34) ** 2 or ring.sum() < 0.9 * around.sum():
            continue
        level = np.median(density[ring])
        centre = np.array(place)
        for _ in range(20):
            near = (np.hypot(grid_x - centre[0], grid_y - centre[1]) < REACH) & inside
            weight = np.clip(level - density[near], 0, None)
            if not weight.any():  # at the rim, or a bright place
                break
            centre = np.array([np.average(grid_x[near], weights=weight), np.average(grid_y[near], weights=weight)])
        near = (np.hypot(grid_x - centre[0], grid_y - centre[1]) < 0.7 * REACH) & inside
        if not weight.any() or not near.any() or density[near].mean() > 0.9 * level:  # not a dark spot
            continue
        if np.hypot(*(centre - place)) < REACH:
            found.append((tuple(int(index) for index in hkl), centre, np.hypot(*(centre - place))))
    return found


def nickel(path):
    """Which projection fits the poles best, with a free orientation and a free scale."""
    fit = ae.maps.fit_orientation("Ni", list(SEEDS), list(SEEDS.values()))
    for _ in range(2):  # three poles predict the others, and all of them predict better
        print(f"scale {fit.projection.scale:.2f} mm/rad, poles within {fit.rms:.2f} mm (RMS)")
        found = spots(path, fit)
        fit = ae.maps.fit_orientation("Ni", [hkl for hkl, *_ in found], [place for _, place, _ in found])
    for hkl, centre, moved in found:
        print(f"  {hkl} at ({centre[0]:.2f}, {centre[1]:.2f}) mm, {moved:.2f} mm from its prediction")
    normals = np.array([hkl for hkl, *_ in found], float)
    normals /= np.linalg.norm(normals, axis=1)[:, None]
    places = np.array([centre for _, centre, _ in found])
    laws = {
        "equidistant": lambda angle: angle,
        "tan": np.tan,
        "stereographic": lambda angle: 2 * np.tan(angle / 2),
        "sin": np.sin,
    }
    for shank, radius in ((2.0, 50.0), (5.0, 50.0), (10.0, 50.0)):
        lens = ae.detection.LocalElectrode.preset("local electrode", shank_angle=shank).projection(radius)
        laws[f"lens, shank {shank:g}"] = lambda angle, lens=lens: np.tan(
            np.radians(lens.flight_angles(np.clip(np.degrees(angle), 0, 50)))
        )
    start = fit.orientation.matrix
    for name, law in laws.items():

        def residuals(free, law=law):
            turned = normals @ (scipy.spatial.transform.Rotation.from_rotvec(free[:3]).as_matrix() @ start).T
            angle = np.arccos(np.clip(turned[:, 2], -1, 1))
            radial = np.exp(free[3]) * law(angle) / np.hypot(*turned[:, :2].T)
            return (turned[:, :2] * radial[:, None] - places).ravel()

        best = scipy.optimize.least_squares(residuals, [0, 0, 0, np.log(fit.projection.scale)])
        errors = np.hypot(*best.fun.reshape(-1, 2).T)
        print(
            f"{name}: RMS {np.sqrt(np.mean(errors**2)):.3f} mm, largest {errors.max():.2f} mm, "
            f"scale {np.exp(best.x[3]):.2f} mm"
        )


def silicon(path):
    """Differences from the positions in the file, with their radii, for a constant compression and for lenses."""
    hits = ae.read(path)
    x, y, stored = (column.astype(float) for column in hits.require("x", "y", "positions"))
    middle = np.array([x.min() + x.max(), y.min() + y.max()]) / 2
    rim = float(np.percentile(np.hypot(x - middle[0], y - middle[1]), 99.9))
    if np.corrcoef(np.arange(len(x)), stored[:, 2])[0, 1] > 0:
        stored = stored * (1, 1, -1)
    edges = np.linspace(0, len(x), 101).astype(int)
    caps = []  # as in examples/stored_positions.py
    for first, last in pairwise(edges):
        squares = (stored[first:last, :2] ** 2).sum(axis=1)
        columns = np.column_stack([np.ones(last - first), squares, squares**2, np.linspace(0, 1, last - first)])
        caps.append(-0.5 / np.linalg.lstsq(columns, stored[first:last, 2], rcond=None)[0][1])
    radii = np.interp(np.arange(len(x)), (edges[:-1] + edges[1:]) / 2, caps)

    def errors(constants, lens, every):
        x_centre, y_centre, size, efficiency, *terms = constants
        place = ((x[::every] - x_centre) + 1j * (y[::every] - y_centre)) / rim
        mirrored = place.conj()
        terms = np.array(terms[0::2]) + 1j * np.array(terms[1::2])
        place = rim * (place + terms @ np.array([mirrored, place**2, place * mirrored, mirrored**2]))
        image = {"projection": "bas", "compression": np.exp(size), "distance": 90.0}
        reconstruction = ae.reconstruct(
            ae.Hits(x=place.real, y=place.imag, positions=stored[::every]),
            atomic_volume=ae.material("Si").a ** 3 / 8,
            area=np.pi * rim**2,
            protocol="cap",
            radius=radii[::every],
            efficiency=min(np.exp(efficiency) / every, 1.0),
            **(image if lens is None else {"lens": lens, "distance": np.exp(size)}),
        )
        return reconstruction.errors(stored[::every], fit=("shift", "rotation"))

    for shank in (None, 5.0, 10.0, 14.8):
        lens = None if shank is None else ae.detection.LocalElectrode.preset("local electrode", shank_angle=shank)
        low, high, start = (0.0, np.log(4), np.log(3.2)) if lens is None else (2.5, 5.5, np.log(40.0))
        best = scipy.optimize.least_squares(
            lambda constants, lens=lens: errors(constants, lens, 800).residuals.ravel(),
            [*middle, start, np.log(0.4), *[0.0] * 8],
            bounds=([*(middle - rim), low, -3.0, *[-0.5] * 8], [*(middle + rim), high, 0.0, *[0.5] * 8]),
            x_scale=[1.0, 1.0, *[0.1] * 10],
        )
        found = errors(best.x, lens, 20)
        name = "constant compression" if lens is None else f"lens, shank {shank:g} degrees, flight length [mm]"
        print(
            f"{name} {np.exp(best.x[2]):.2f}, efficiency {np.exp(best.x[3]):.2f}: lateral {found.lateral_rms:.3f} nm, "
            f"depth {found.depth_rms:.3f} nm"
        )


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("tungsten", help="hit list, W_tap.raw")
    parser.add_argument("nickel", help="map of densities, ni111_map.npz")
    parser.add_argument("silicon", help="stored positions, Si.epos")
    options = parser.parse_args()
    tungsten(options.tungsten)
    nickel(options.nickel)
    silicon(options.silicon)


if __name__ == "__main__":
    main()
