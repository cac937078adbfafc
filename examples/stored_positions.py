"""
Reconstruction beside the positions in a file
=============================================

An .epos file contains the detector coordinates of its ions, and the positions that a program reconstructed from them.
This script reconstructs the ions of a file from their detector coordinates and their sequence. It finds the constants
that come closest to the stored positions: centre of the projection, first radius, shank angle, image compression and
efficiency. In a second step the image may also be distorted, as by a reflectron: by linear and quadratic terms of the
detector coordinates. In a third step the radii are those of the spheres on which the stored positions lie. ::

    python stored_positions.py R5083.epos --element Si

The flight length is not in the file. The data hardly distinguish it from the image compression, so it is given by
``--distance``. The script prints the constants and the RMS distances for each protocol and projection, and the mean
distance in rings and depths of the best one. One million ions take a minute.
"""

# sphinx_gallery_thumbnail_path = '../articles/origins/origins.png'

import argparse
from itertools import pairwise

import numpy as np
import scipy

import apt_evap as ae
from apt_evap.specimen import atom_density

parser = argparse.ArgumentParser(description="Reconstruction beside the positions in an .epos file.")
parser.add_argument("file", help=".epos, with detector coordinates and positions")
parser.add_argument("--element", required=True, help="for the atomic volume, for example Si")
parser.add_argument("--distance", type=float, default=90.0, help="flight length [mm]; default: 90")
parser.add_argument("--every", type=int, default=400, help="the fit uses one ion of this number; default: 400")
options = parser.parse_args()

hits = ae.read(options.file)
x, y, stored = (column.astype(float) for column in hits.require("x", "y", "positions"))
element = ae.material(options.element)
volume = 1 / atom_density(element.structure, element.a, element.c)

# %%
# The field of view is the circle around the ions. Its centre need not be that of the projection. z goes out of the
# specimen here, and into it in other files: then it is mirrored.

middle = np.array([x.min() + x.max(), y.min() + y.max()]) / 2
rim = float(np.percentile(np.hypot(x - middle[0], y - middle[1]), 99.9))
if np.corrcoef(np.arange(len(x)), stored[:, 2])[0, 1] > 0:
    stored = stored * (1, 1, -1)
print(f"{hits!r}\nfield of view: radius {rim:.2f} mm about ({middle[0]:.2f}, {middle[1]:.2f}) mm")


# %%
# Radius of the cap in windows of the sequence: the stored depth is a parabola of the distance from the axis, with a
# term of order four for the sphere.

edges = np.linspace(0, len(x), 101).astype(int)
cap_radii = []
for first, last in pairwise(edges):
    squares = (stored[first:last, :2] ** 2).sum(axis=1)
    columns = np.column_stack([np.ones(last - first), squares, squares**2, np.linspace(0, 1, last - first)])
    cap_radii.append(-0.5 / np.linalg.lstsq(columns, stored[first:last, 2], rcond=None)[0][1])
radii = np.interp(np.arange(len(x)), (edges[:-1] + edges[1:]) / 2, cap_radii)
print(f"stored positions on caps of R {radii[0]:.1f} to {radii[-1]:.1f} nm")


def reconstructed(constants, protocol, projection, every=1, of_caps=False):
    """Reconstruction of every n-th ion: of n ions each stands for n, which the efficiency contains."""
    x_centre, y_centre, log_radius, shank_angle, log_compression, log_efficiency, *terms = constants
    place = ((x[::every] - x_centre) + 1j * (y[::every] - y_centre)) / rim
    terms = np.array(terms[0::2]) + 1j * np.array(terms[1::2]) if terms else np.zeros(4)
    mirrored = place.conj()
    place = place + terms @ np.array([mirrored, place**2, place * mirrored, mirrored**2])
    shape = {"radius": "shank", "initial_radius": np.exp(log_radius), "shank_angle": shank_angle}
    ions = ae.Hits(x=rim * place.real, y=rim * place.imag, positions=stored[::every])
    return ae.reconstruct(
        ions,
        atomic_volume=volume,
        distance=options.distance,
        area=np.pi * rim**2,
        protocol=protocol,
        projection=projection,
        **({"radius": radii[::every]} if of_caps else shape),
        compression=np.exp(log_compression),
        efficiency=min(np.exp(log_efficiency) / every, 1.0),
    )


def compared(reconstruction, every=1):
    """Distances from the stored positions after a shift and a rotation about the axis."""
    return reconstruction.errors(stored[::every], fit=("shift", "rotation"))


# %%
# The constants of each choice, by least squares of all coordinates.

start = [*middle, np.log(20.0), 10.0, np.log(1.5), np.log(0.5)]
low = [*(middle - rim), 1.0, 0.0, 0.0, -3.0]
high = [*(middle + rim), 6.0, 40.0, np.log(4.0), 0.0]
scales = [1.0, 1.0, 0.1, 3.0, 0.1, 0.1]
best = None
for step, terms, of_caps in (("radial image", 0, False), ("distorted image", 8, False), ("and radii of caps", 8, True)):
    for choices in (("bas", "bas"), ("cap", "bas"), ("cap", "equidistant")):

        def residuals(constants, choices=choices, of_caps=of_caps):
            result = reconstructed(constants, *choices, options.every, of_caps)
            return compared(result, options.every).residuals.ravel()

        bounds = [*low, *[-0.5] * terms], [*high, *[0.5] * terms]
        start = [*start[: 6 + terms], *[0.0] * (6 + terms - len(start))]
        found = scipy.optimize.least_squares(residuals, start, bounds=bounds, x_scale=[*scales, *[0.1] * terms])
        start = found.x
        reconstruction = reconstructed(found.x, *choices, of_caps=of_caps)
        errors = compared(reconstruction)
        constants = reconstruction.settings
        shank = f", shank {constants['shank_angle']:.1f} degrees" if "shank_angle" in constants else ""
        print(
            f"{step}, {' '.join(choices)}: lateral {errors.lateral_rms:.3f} nm, depth {errors.depth_rms:.3f} nm\n"
            f"  centre ({found.x[0]:.2f}, {found.x[1]:.2f}) mm, R {reconstruction.radii[0]:.1f} to "
            f"{reconstruction.radii[-1]:.1f} nm{shank}, compression {constants['compression']:.2f}, efficiency "
            f"{constants['efficiency']:.2f}, rotation {errors.rotation:.2f} degrees",
            flush=True,
        )
        if best is None or errors.lateral_rms < best.lateral_rms:
            best = errors

# %%
# Where the best one differs: means are errors of the constants or of the model, scatter is that of single ions.

field = best.residual_field(angle_width=4.0, depth_bins=5)
for name in ("radial", "azimuthal", "depth", "lateral_scatter", "depth_scatter"):
    print(f"{name} [nm], rows: rings of 4 degrees, columns: depths")
    print(np.round(getattr(field, name), 2))
