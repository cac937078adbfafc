"""Energy along the surface from the gain of the hop, beside other rules, on runs with responses.

    python energies.py RUNS simulate Ni 80 --skip 30000 --ions 90000
    python energies.py RUNS judge Ni 80

Amplitudes are those of `../three_metals/judge.py`, against its folded densities; for magnesium the densities on the
line towards {01-13} and beside it. The gain is a line over the charge ratio, from
`hops.py` for the same metal and radius.
"""

import argparse
import sys
import warnings
from dataclasses import replace
from pathlib import Path

import numpy as np

sys.path.append(str(Path(__file__).parents[1] / "three_metals"))
from judge import METALS, amplitude, folded, map_of, projection_of, rings
from measured_numbers import measured_fold
from predictions import across
from runs import AXES, advanced
from shares import CHOICES, of_file

import apt_evap as ae

PREDICTED = {
    "Ni-001": ((0, 0, 1), 19.0), "Fe-001": ((0, 0, 1), 19.0), "Fe-025": ((0, 2, 5), 23.0), "Fe-112": ((1, 1, 2), 19.0),
    "Si-001": ((0, 0, 1), 19.0), "W-011": ((0, 1, 1), 19.0),
}  # fmt: skip
AXES = AXES | {"Mg": ((0, 0, 0, 1), 20.0)} | PREDICTED  # and half the opening angle of the flights [degrees]
PARTS = (0.01, 0.015, 0.02, 0.03, 0.035, 0.04, 0.05, 0.07, 0.1)
# amplitudes by the rule of the metal for each radius (../three_metals): how they fall with it
BY_RADIUS = {
    "W": {80: (1.31, 1.49, 1.75), 160: (0.92, 0.97, 1.23), 230: (0.69, 0.77, 1.03)},
    "Ni": {80: (1.46, 1.09, 1.24), 160: (1.18, 0.81, 0.98), 230: (1.01, 0.58, 0.74)},
}
ENERGIES = (0.03, 0.05, 0.1, 0.15, 0.2, 0.3, 0.5)  # eV


class Gains:
    """Mean energies of the ions of one batch, with a spread of the same size (before truncation)."""

    def __init__(self, means):
        self.means, self.unit = means, ae.TruncatedNormal(1.0, 1.0)

    def quantile(self, u):
        """Energies [eV]."""
        return self.means * self.unit.quantile(u)


class ByGain:
    """The rule of the metal with the energy eta G, or eta (G - Q), along the roll-up, and atoms by a threshold of G.

    Parameters
    ----------
    line : tuple
        G = start + slope x [eV].
    scale : float
        Simulated energy per real energy.
    """

    def __init__(self, metal, line, part, scale, by_gain=False, less=False):
        self.metal, self.line, self.part, self.scale = metal, line, part, scale
        self.by_gain, self.less = by_gain, less
        self.cost = ae.emission.Migration.of(metal, temperature=80.0).cost  # of half the bonds

    def gains(self, emissions):
        """G of each ion [eV]; 0 without a neighbour."""
        ratios = np.nan_to_num(emissions.charge_ratios[:, 0])
        return np.where(ratios > 0, self.line[0] + self.line[1] * ratios, 0.0)

    def probabilities(self, emissions):
        """Whether each ion rolls up."""
        return (self.gains(emissions) > self.cost).astype(float)

    def tangential(self, emissions, random):
        """See `Combined.tangential`."""
        rule = ae.RollUp.of_metal(self.metal, energy_scale=self.scale)
        means = np.maximum(self.gains(emissions) - (self.cost if self.less else 0.0), 1e-3) * self.part * self.scale
        probability = self if self.by_gain else rule.probability
        others = rule.others
        rule = ae.RollUp(Gains(means), probability, 1.0, 0.2, others=others, others_height=0.0)
        return rule.tangential(emissions, random)


def simulated(metal, radius, skip, ions, threads):
    """Run with responses for every emission."""
    axis, half_angle = AXES[metal]
    material = ae.material(metal.partition("-")[0])
    size = radius * material.a
    tip = ae.Tip(material, size, axis=axis, shank_length=size, depth=8 * material.a, offset_seed=1)
    simulation = advanced(tip, half_angle, skip, rule=ae.ConstantPotential(), seed=1, n_threads=threads)
    return simulation.run(ions, progress=False)


def gain_line(metal, path):
    """Start and slope of the gain over the charge ratio [eV], from a file of `hops.py`."""
    hops = of_file(path)
    slope, start = np.polyfit(hops["ratio"], CHOICES["charge above, half, cap, F_evap"].gains(metal, hops), 1)
    return start, slope


def rules(metal, line, scale):
    """Rules: kind, the number that is varied, and the emission."""
    rule = ae.RollUp.of_metal(metal, energy_scale=scale)
    yield "rule of the metal", 1.0, rule
    for part in PARTS:
        yield "eta G", part, ByGain(metal, line, part, scale)
    for part in PARTS:
        yield "eta G, atoms by G", part, ByGain(metal, line, part, scale, by_gain=True)
    for part in (0.02, 0.05, 0.1, 0.2, 0.35):
        yield "eta (G - Q), atoms by G", part, ByGain(metal, line, part, scale, by_gain=True, less=True)
    for energy in ENERGIES:
        spread = ae.TruncatedNormal(energy * scale, energy * scale)
        yield "one energy [eV]", energy, replace(rule, energy=spread)


def judged(metal, radius, run, line):
    """Print the table of one run."""
    scale = float(np.median(run.at_evaporation_field().energy_scales))
    projection, orientation = projection_of(run), ae.Orientation.from_settings(run.settings["tip"])
    found = ae.maps.poles(orientation.material, 10)
    normals = orientation.directions(found.normals)
    series = {}
    for kind, number, rule in rules(metal, line, scale):
        name = f"{kind}, {number:g}"
        map = map_of(run, rule)
        if metal == "Mg":
            pole = np.array([0.0, 0.0, 1.0])
            toward = normals[named(found.planes, (0, 1, 3)) & (normals[:, 2] > 0.5)]
            (on, on_error), (beside, beside_error) = across(map, projection, pole, toward, 16)
            radial = ae.maps.pole_profile(map, projection, pole, np.arange(0, 11, 1.0)).density
            print(f"{name:30} on {on:.2f} +- {on_error:.2f} beside {beside:.2f} +- {beside_error:.2f} | pole",
                  " ".join(f"{density:.2f}" for density in radial), flush=True)  # fmt: skip
            continue
        target = measured_fold(metal)
        fold = folded(map, orientation, projection, METALS[metal])
        pairs = zip(rings(fold, METALS[metal]), rings(target, METALS[metal]), strict=True)
        values = [amplitude(a, b) for a, b in pairs]
        text = " ".join(f"{value:5.2f}" for value in values)
        print(f"{name:30} correlation {fold.correlation(target):.2f}, amplitudes {text}", flush=True)
        series.setdefault(kind, []).append((number, values))
    known = BY_RADIUS.get(metal, {})
    for larger in [radius, *(other for other in known if other > radius)]:
        factors = np.divide(known[larger], known[radius]) if larger > radius else 1.0
        for kind, rows in list(series.items())[1:]:
            numbers, values = zip(*rows, strict=True)
            best(f"R = {larger} a, {kind}", numbers, [np.multiply(row, factors) for row in values])


def best(name, numbers, amplitudes):
    """Print the number at which the mean logarithm of the amplitudes is 0, its range for 7 %, and the RMS there."""
    logs = np.log(np.maximum(amplitudes, 1e-3))
    means = logs.mean(axis=1)
    if not means.min() < 0 < means.max():
        print(f"{name}: mean logarithms of the amplitudes {means.round(2)}")
        return
    low, middle, high = np.exp(np.interp([-0.07, 0.0, 0.07], means, np.log(numbers)))
    rest = np.sqrt(np.mean([np.interp(np.log(middle), np.log(numbers), column) ** 2 for column in logs.T]))
    print(f"{name}: {middle:.3f} [{low:.3f}, {high:.3f}], RMS of the logarithms {rest:.2f}")


def named(planes, indices):
    """Planes of the kind {hkil} of magnesium by the absolute values of h, k (in any order) and l."""
    h, k, last = (np.asarray(planes)[:, i] for i in (0, 1, -1))
    kinds = np.sort(np.abs(np.column_stack([h, k, -h - k])), axis=1)
    wanted = np.sort(np.abs([indices[0], indices[1], -indices[0] - indices[1]]))
    return (kinds == wanted).all(axis=1) & (np.abs(last) == indices[2])


def main():
    """Simulate, or print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("runs", type=Path)
    parser.add_argument("what", choices=("simulate", "judge"))
    parser.add_argument("metal", choices=AXES)
    parser.add_argument("radius", type=int, help="in lattice constants")
    parser.add_argument("--skip", type=int, default=30_000)
    parser.add_argument("--ions", type=int, default=90_000)
    parser.add_argument("--hops", type=Path, help="file of hops.py, if there is none for this radius")
    parser.add_argument("--threads", type=int)
    options = parser.parse_args()
    warnings.simplefilter("ignore", ae.warnings.ResponseWarning)
    metal, radius = options.metal, options.radius
    path = options.runs / f"{metal}_{radius}.h5"
    if options.what == "simulate":
        simulated(metal, radius, options.skip, options.ions, options.threads).save(path)
        return
    start, slope = gain_line(metal, options.hops or options.runs / f"{metal}_{radius}_hops.npz")
    run = ae.load(path)
    law = ae.emission.Migration.of(metal)
    print(f"{metal}, R = {radius} a, {len(run):,} ions, G = {start:.2f} + {slope:.2f} x; part that rolls: rule "
          f"{law.probabilities(run.emissions).mean():.2f}, by G "
          f"{ByGain(metal, (start, slope), 0.04, 1.0).probabilities(run.emissions).mean():.2f}")  # fmt: skip
    judged(metal, radius, run, (start, slope))


if __name__ == "__main__":
    main()
