"""Rules of emission on one run with responses, against a measured map: no rule needs a new run.

    python runs.py RUNS W 160 --ions 200000 --fly responses
    python rules.py W W3.epos RUNS/W_160_others_1_responses.h5

The lines of the table are those of `judge.py`. A rule with a threshold rolls up the atoms whose strongest neighbour has
more than this part of their charge (`ChargeRatio`); the others start from their sites, in random directions. With
--rivals, only the law of migration and rules that are not of its kind: forces of the neighbours, two equal targets,
mixtures, and second roll-ups if the run covers them.
"""

import argparse
import warnings

import numpy as np
from judge import METALS, folded, map_of, measured_of, projection_of, row
from runs import HEIGHT

import apt_evap as ae

STEP = 0.01
"""Width of the threshold of a charge ratio."""


FREE_ATOMS = {"W": 11.2e-40, "Ni": 6.8e-40, "Al": 9.8e-40}
"""Polarisabilities of free atoms [F m^2]: `ae.material`; tungsten: Schwerdtfeger and Nagle, Mol. Phys. 117, 1200."""


def laws(name):
    """Thresholds of laws of rolling for a metal, each with its one constant from tungsten: threshold 0.66."""
    tungsten, metal = (ae.emission.Migration.of(each) for each in ("W", name))

    def threshold(start, slope, tungsten_atom=1.0, metal_atom=1.0):
        """The line of `migration.py`, and the polarisabilities of the atoms; that of tungsten fixes their unit."""
        gained = (start + slope * tungsten.threshold) ** 2 - 1.0
        gained *= metal.cost / tungsten.cost * tungsten.field**2 * tungsten_atom / (metal.field**2 * metal_atom)
        return ((gained + 1.0) ** 0.5 - start) / slope

    return {
        "migration": metal.threshold,
        "migration, field of the others": threshold(1.075, 0.358),
        "migration, free atoms": threshold(1.27, 1.54, FREE_ATOMS["W"], FREE_ATOMS[name]),
        "one charge ratio": tungsten.threshold,
    }


def rolled(energy, *, probability=1.0, sharpness=0.4, height=2 * HEIGHT, others=None):
    """Roll-up with a mean energy of all ions [eV], unless that of the others is given."""
    spread = ae.TruncatedNormal(energy, energy)
    rest = spread if others is None else ae.TruncatedNormal(others, others)
    return ae.RollUp(spread, probability, sharpness, height, others=rest)


class Pushed:
    """Start from the site, away from the strongest neighbour, as the force of its charge does."""

    def __init__(self, energy, height):
        self.energy, self.height = energy, height

    def tangential(self, emissions, random):
        """See `Combined.tangential`."""
        there, first, second = ae.emission.rollup_direction(emissions)
        speed = ae.units.speed_from_energy(self.energy.quantile(random.uniform(1)[:, 0]), emissions.masses)
        heights = np.full(len(there), self.height)
        return ae.emission.TangentialLaunches(np.zeros_like(there), -speed * first, -speed * second, None, heights)


class Bridge:
    """Roll-up by a law, onto the middle between the two strongest neighbours if their charges are nearly equal."""

    def __init__(self, rule, least):
        self.rule, self.least = rule, least

    def tangential(self, emissions, random):
        """See `Combined.tangential`."""
        launches = self.rule.tangential(emissions, random)
        shares = np.tile([1.0, 0.0, 0.0], (len(emissions), 1))
        shares[second_over_first(emissions) > self.least] = [0.5, 0.5, 0.0]
        return launches._replace(shares=shares)


class NotBetweenTwo:
    """Probability of a law, but 0 for atoms whose two strongest neighbours have nearly equal charges."""

    def __init__(self, law, most):
        self.law, self.most = law, most

    def probabilities(self, emissions):
        """See `RollProbability`."""
        return np.where(second_over_first(emissions) > self.most, 0.0, self.law.probabilities(emissions))


def second_over_first(emissions):
    """Charge of the second target over that of the first; 0 without a second one."""
    ratios = emissions.charge_ratios
    return np.nan_to_num(ratios[:, 1] / ratios[:, 0])


def rivals(name, scale):
    """The law of migration, and rules of other kinds."""
    law = ae.emission.Migration.of(name)
    energy = ae.TruncatedNormal(0.2 * scale, 0.2 * scale)
    polarization = law.polarization * scale
    one = rolled(0.2 * scale, probability=law, sharpness=2.0)
    sharp = rolled(0.2 * scale, probability=law, sharpness=0.0)
    found = {"the rule of the metal": ae.RollUp.of_metal(name, energy_scale=scale)}
    for part in (0.22, 0.26, 0.3, 0.34):
        for sharpness in (1.0, 1.5, 2.0):
            rule = rolled(part * polarization, probability=law, sharpness=sharpness, others=0.35 * scale)
            found[f"{part:g} of the polarisation, sharpness {sharpness:g}"] = rule
    found |= {"migration, 0.2 eV, sharpness 2": one, "migration, 0.2 eV, sharpness 0": sharp}
    for push in (0.2, 0.7):
        found[f"pushed by the neighbour, {push:g} eV"] = Pushed(
            ae.TruncatedNormal(push * scale, push * scale), 2 * HEIGHT
        )
    for least in (0.7, 0.9):
        found[f"onto a bridge of two > {least:g}"] = Bridge(sharp, least)
        found[f"not between two > {least:g}"] = rolled(
            0.2 * scale, probability=NotBetweenTwo(law, least), sharpness=2.0
        )
    for part in (0.2, 0.4):
        lateral = ae.LateralVelocity(energy, 2 * HEIGHT)
        found[f"{part:g} at random, whatever the law"] = ae.emission.Mixture((one, lateral), (1 - part, part))
        found[f"{part:g} onto the strongest"] = ae.emission.Mixture((one, sharp), (1 - part, part))
    return found


def rules(name, scale):
    """Rules by name; `scale` is the simulated energy per real energy."""
    found = {"unperturbed": ae.Unperturbed()}
    for law, threshold in laws(name).items():
        given = ae.emission.Migration.of(name) if law == "migration" else ae.emission.ChargeRatio(threshold, 0.0015)
        found[f"{law}, {threshold:.2f}"] = rolled(0.2 * scale, probability=given, sharpness=2.0)
    for temperature in (20.0, 150.0):
        law = ae.emission.Migration.of(name, temperature)
        found[f"migration at {temperature:g} K"] = rolled(0.2 * scale, probability=law, sharpness=2.0)
    for energy in (0.1, 0.2, 0.35, 0.7, 1.2):
        found[f"all, {energy:g} eV"] = rolled(energy * scale)
    for sharpness in (0.05, 0.15, 0.8):
        found[f"all, sharpness {sharpness:g}"] = rolled(0.35 * scale, sharpness=sharpness)
    for fraction in (0.5, 0.6, 0.8):
        found[f"fraction {fraction:g}"] = rolled(0.35 * scale, probability=fraction)
    for ratio in (0.50, 0.58, 0.62, 0.66, 0.70, 0.74, 0.78, 0.82, 0.86):
        found[f"ratio > {ratio:.2f}, 0.2 eV"] = rolled(0.2 * scale, probability=ae.emission.ChargeRatio(ratio, STEP))
    threshold = ae.emission.ChargeRatio(0.66, STEP)
    for energy in (0.1, 0.35, 0.7):
        found[f"ratio > 0.66, {energy:g} eV"] = rolled(energy * scale, probability=threshold)
    for sharpness in (0.15, 0.8, 2.0):
        found[f"ratio > 0.66, 0.2 eV, sharpness {sharpness:g}"] = rolled(
            0.2 * scale, probability=threshold, sharpness=sharpness
        )
    found["ratio > 0.66, 0.2 eV, others 0.7 eV"] = rolled(0.2 * scale, probability=threshold, others=0.7 * scale)
    for width in (0.03, 0.1):
        soft = ae.emission.ChargeRatio(0.66, width)
        found[f"ratio > 0.66, 0.2 eV, width {width:g}"] = rolled(0.2 * scale, probability=soft)
    return found


def main():
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("metal", choices=METALS)
    parser.add_argument("measured", help="ions, or a map of densities")
    parser.add_argument("run", help="with responses")
    parser.add_argument("--rivals", action="store_true", help="rules that are not a threshold")
    options = parser.parse_args()
    warnings.simplefilter("ignore", ae.warnings.ResponseWarning)  # tails of the broad energies are extrapolated
    metal = METALS[options.metal]
    target = folded(*measured_of(options.metal, options.measured), metal)
    row("measured", target, target, metal)
    run = ae.load(options.run)
    ratios = run.emissions.charge_ratios[:, 0]
    projection, orientation = projection_of(run), ae.Orientation.from_settings(run.settings["tip"])
    scale = float(np.median(run.at_evaporation_field().energy_scales))
    metal_name = options.metal.partition("-")[0]
    for name, rule in (rivals(metal_name, scale) if options.rivals else rules(metal_name, scale)).items():
        threshold = getattr(getattr(rule, "probability", None), "threshold", None)  # of a charge ratio, or a law
        part = "" if threshold is None else f" ({np.mean(ratios > threshold):.2f} roll)"
        row(name + part, folded(map_of(run, rule), orientation, projection, metal), target, metal)


if __name__ == "__main__":
    main()
