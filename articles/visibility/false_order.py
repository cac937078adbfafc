"""
Apparent short-range order of random alloys
===========================================

Random Ni[111] alloys with 10 % of a solute (Al on the sites of Ni), R = 20 lattice constants, 27,000 ions. The solute
has 0.8 times the evaporation field of Ni, or the same. The ions are reconstructed with the constants that fit their
true sites best. The script prints the Warren-Cowley parameters within 0.3 nm and draws false_order.png: one run takes
16 s of processor time, and 35 s with the responses that other energies need.
"""

import argparse
from pathlib import Path

import numpy as np

import apt_evap as ae

NICKEL = ae.material("Ni")
SHELLS = np.arange(0.2, 1.01, 0.1)


def evaporate(ratio, seed, responses):
    """Run of a random alloy."""
    solutes = {ae.material("Al", a=NICKEL.a): 0.1}
    alloy = ae.specimen.Phase(
        "alloy", NICKEL, solutes=solutes, evaporation_field={"Al": ratio * NICKEL.evaporation_field}
    )
    tip = ae.Tip(
        phases=[alloy], apex_radius=20 * NICKEL.a, axis=(1, 1, 1), shank_length=20 * NICKEL.a, depth=6.0, seed=seed,
        offset_seed=seed,
    )  # fmt: skip
    flown = [] if responses else [ae.Unperturbed()]
    return ae.Simulation(tip, seed=seed).run(27_000, flown, responses=responses, progress=False)


parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
parser.add_argument("--runs", type=int, default=3, help="runs of each alloy; default: 3")
parser.add_argument("--redraw", action="store_true", help="load the runs that an earlier call has saved")
parser.add_argument("-o", "--output", type=Path, default=Path(), help="folder for the runs and the picture")
options = parser.parse_args()
options.output.mkdir(parents=True, exist_ok=True)
alloys = {}
for ratio, responses in ((0.8, True), (1.0, False)):
    alloys[ratio] = []
    for seed in range(1, options.runs + 1):
        path = options.output / f"alloy_{ratio}_{seed}.h5"
        if not options.redraw:
            evaporate(ratio, seed, responses).save(path)
        alloys[ratio].append(ae.load(path))

rest, energies = ae.Unperturbed(), ae.TruncatedNormal(0.3, 0.3)
CASES = {
    "equal fields": (1.0, rest),
    "field 0.8": (0.8, rest),
    "0.8, lateral 0.2 eV": (0.8, ae.LateralVelocity(0.2)),
    "0.8, lateral 0.5 eV": (0.8, ae.LateralVelocity(0.5)),
    "0.8, energies, 40 % roll": (0.8, ae.RollUp(energies, probability=0.4, others=energies)),
    "0.8, all roll at 0.2 eV": (0.8, ae.RollUp(0.2)),
}
figure = ae.plot.new_figure((9.6, 4.0))
figure.set_layout_engine("compressed")
left, right = figure.subplots(1, 2)
for place, (name, (ratio, perturbation)) in enumerate(CASES.items()):
    order = ae.studies.false_order(alloys[ratio], "Al", None, perturbation)
    print(name, order, order.unlike, flush=True)
    for shift, part, color in ((-0.2, "true", "C2"), (0, "shuffled", "0.5"), (0.2, "reconstructed", "C3")):
        each = getattr(order, part)
        label = part if place == 0 else None
        left.errorbar(each.value, place + shift, xerr=each.error, fmt="o", color=color, capsize=3, label=label)
left.axvline(0, color="0.8", zorder=0)
left.set(yticks=range(len(CASES)), yticklabels=list(CASES), xlabel="Warren-Cowley parameter within 0.3 nm")
left.invert_yaxis()
left.legend(frameon=False)
for ratio, color in ((1.0, "C0"), (0.8, "C3")):
    orders = [ae.studies.false_order(alloys[ratio], "Al", None, rest, shell=shell) for shell in SHELLS]
    for part, style in (("true", "o:"), ("reconstructed", "o-")):
        each = [getattr(order, part) for order in orders]
        right.errorbar(
            SHELLS, [number.value for number in each], [number.error for number in each], fmt=style, color=color,
            capsize=2, markersize=3, label=f"field {ratio:g}, {part}",
        )  # fmt: skip
right.axhline(0, color="0.8", zorder=0)
right.set(xlabel="largest distance of neighbours [nm]", ylabel="Warren-Cowley parameter")
right.legend(frameon=False)
figure.savefig(options.output / "false_order.png", dpi=100)
