"""
Spheres and a monolayer: are they visible, and how wrong do they come out?
==========================================================================

Spheres of Al with 25 % Cu in Al[012] with 5 % Cu, R = 8 nm, with 0.8, 1 and 1.2 times the evaporation field of the
matrix; and a monolayer with 50 % Cu, 0.2 nm thick, across the axis and along it. The instrument has an efficiency of 50
%. The analysis counts the pairs of Cu ions within 3 nm of the feature that are closer than 0.6 nm. For each feature,
full simulations make the operators and the emulator draws the twins. The script prints a table with the processor time
of each answer and writes table.json. It takes eleven minutes of a processor core.
"""

import argparse
import json
import time
from pathlib import Path

import scipy

import apt_evap as ae

R, COVER = 8.0, 0.5
ALUMINIUM = ae.material("Al")
INSTRUMENT = ae.Instrument(distance=100.0, field_of_view=160.0, efficiency=0.5)


def pairs(positions, labels):
    """Number of pairs of Cu ions closer than 0.6 nm."""
    tree = scipy.spatial.cKDTree(positions[labels == 1])
    return tree.count_neighbors(tree, 0.6)


def sphere(radius, ratio):
    """A sphere below the apex."""
    region = ae.specimen.Sphere((0, 0, R - COVER - radius), radius)
    field = ratio * ALUMINIUM.evaporation_field
    return ae.specimen.Phase("sphere", ALUMINIUM, region, solutes={"Cu": 0.25}, evaporation_field=field)


def layer(normal, ratio):
    """A monolayer of Cu across the axis, 1.5 nm below the apex, or along it, through the apex."""
    middle = R - 1.5 if normal[2] else 0.0
    region = ae.specimen.Layer(middle - 0.1, middle + 0.1, normal)
    field = ratio * ALUMINIUM.evaporation_field
    return ae.specimen.Phase("layer", ALUMINIUM, region, solutes={"Cu": 0.5}, evaporation_field=field)


parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
parser.add_argument("--twins", type=int, default=40, help="twins of each feature, and with other sizes; default: 40")
parser.add_argument("-o", "--output", type=Path, default=Path(), help="folder for the table and the operators")
options = parser.parse_args()
options.output.mkdir(parents=True, exist_ok=True)

cases = {f"sphere {r:g} nm, field {ratio:g}": (sphere(r, ratio), pairs) for ratio in (0.8, 1.0, 1.2) for r in (1.0,)}
for name, normal in (("across", (0, 0, 1)), ("along", (1, 0, 0))):
    cases |= {f"monolayer {name}, field {ratio:g}": (layer(normal, ratio), pairs) for ratio in (0.8, 1.0, 1.2)}
field = ALUMINIUM.evaporation_field  # of Cu in the matrix, too
matrix = ae.specimen.Phase("matrix", ALUMINIUM, solutes={"Cu": 0.05}, evaporation_field=field)
tip = ae.Tip(phases=[matrix], apex_radius=R, axis=(0, 1, 2), shank_length=2 * R, depth=4.0, seed=1)
table = {}
for name, (feature, analysis) in cases.items():
    start = time.process_time()
    is_sphere = name.startswith("sphere")
    axes = {"size": [0.5, 1.0, 2.0] if is_sphere else [0.2]}
    operators = ae.studies.origin_operators(feature, tip, INSTRUMENT, axes=axes, n_threads=1)
    operators.save(options.output / f"{name.replace(' ', '_').replace(',', '')}.h5")
    made = time.process_time() - start
    for r in axes["size"]:
        variant = sphere(r, float(name.split()[-1])) if is_sphere else feature
        begin = time.process_time()
        answer = ae.studies.estimate_visibility(
            variant, tip, INSTRUMENT, analysis, operators=operators, reach=3.0, twins=options.twins, seed=10
        )
        row = answer.to_dict() | {"seconds": time.process_time() - begin, "operators": made}
        table[f"{name}; {r:g}"] = row
        print(name, r, json.dumps(row), flush=True)
(options.output / "table.json").write_text(json.dumps(table, indent=1))
