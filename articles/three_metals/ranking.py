"""How measures of likeness rank ten rules of emission: on the measured maps, and on twins whose rule is known.

    python ranking.py measured W W3.epos RUNS/W_160_others_1_responses.h5
    python ranking.py twins Ni RUNS/Ni_160_others_1.h5 RUNS/Ni_160_others_2.h5

Simulated ions are shown on the measured detector by both orientations, nothing is registered. Measures: structural
similarity (SSIM), plain and with the correction for the noise of the map, correlation and concordance of folded
densities. A twin is a map of 50,000 ions of the second specimen by one of the rules; the rules are those of the first
specimen. With --displaced, the twins are enlarged by 3 %, as by an image compression that is not known.
"""

import argparse
import itertools
import warnings

import numpy as np
from judge import METALS, folded, measured_of, projection_of
from rules import rolled

import apt_evap as ae
from apt_evap.fit.comparison import Comparison

SMOOTHING = 0.6  # degrees
MEASURES = ("SSIM", "SSIM, noise-corrected", "folded correlation", "folded concordance")


def rules_of_metal(metal, scale):
    """Rules for a run with responses; `scale` is the simulated energy per real energy."""
    law = ae.emission.Migration.of(metal.partition("-")[0])
    broad = ae.TruncatedNormal(1.2 * scale, 1.2 * scale)
    return {
        "unperturbed": ae.Unperturbed(),
        "lateral, 0.35 eV": ae.LateralVelocity(ae.TruncatedNormal(0.35 * scale, 0.35 * scale), 0.1),
        "lateral, 1.2 eV": ae.LateralVelocity(broad, 0.1),
        "all, strongest": ae.RollUp(ae.TruncatedNormal(0.35 * scale, 0.35 * scale)),
        "all, sharpness 0.15": rolled(0.35 * scale, sharpness=0.15),
        "all, sharpness 0.4": rolled(0.35 * scale),
        "all, 1.2 eV": rolled(1.2 * scale),
        "fraction 0.6": rolled(0.35 * scale, probability=0.6),
        "fraction 0.3": rolled(0.35 * scale, probability=0.3),
        "migration, 0.2 eV, sharpness 2": rolled(0.2 * scale, probability=law, sharpness=2.0),
        "the rule of the metal": ae.RollUp.of_metal(metal.partition("-")[0], energy_scale=scale),
    }


def mixed_hits(run):
    """Hits by the rules of a run with flown emissions, and of two mixtures of them."""
    names = ("unperturbed", "lateral", "lateral, 0.2 nm", "strongest", "sharpness 0.15", "sharpness 0.4", "sharpness 2",
             "sharpness 0.4, 0.2 nm")  # fmt: skip
    hits = {name: run.hits(each) for name, each in zip(names, run.perturbations, strict=True)}
    for part in (0.3, 0.6):
        coin = np.random.default_rng(1).random(len(run)) < part
        first, second = hits["sharpness 0.4"], hits["lateral"]
        hits[f"fraction {part:g}"] = (coin, first, second)
    return hits


def crystal_of(run, orientation):
    """Axes of the crystal of a run in the specimen, (3, 3): of the equivalent ones those nearest to an orientation."""
    own = ae.Orientation.from_settings(run.settings["tip"]).matrix
    signs = np.array(list(itertools.product((-1, 1), repeat=3)))
    equivalent = [own[:, order] * sign for order in itertools.permutations(range(3)) for sign in signs]
    return max(equivalent, key=lambda each: each[2] @ orientation.matrix[2])


def directions_of(run, projection, hits, orientation):
    """Directions of arriving ions in the frame of the crystal of an orientation, shape (n, 3)."""
    if isinstance(hits, tuple):
        coin, first, second = hits
        x, y = np.where(coin, first.x, second.x), np.where(coin, first.y, second.y)
        there = np.where(coin, first.detected, second.detected)
    else:
        x, y, there = hits.x, hits.y, hits.detected
    return projection.directions(np.column_stack([x, y])[there]) @ crystal_of(run, orientation)


def counts_on(like, orientation, projection, crystal_directions):
    """Map of crystal directions on the detector of another map."""
    places = projection.places(crystal_directions @ orientation.matrix.T)
    counts, _, _ = np.histogram2d(places[:, 1], places[:, 0], (like.y_edges, like.x_edges))
    return ae.DetectorMap.from_array(counts, like.x_edges, like.y_edges, is_counts=True, mask=like.mask)


def concordance(first, second):
    """Lin's concordance of the flattened densities of two folded maps."""
    known = np.isfinite(first.flattened) & np.isfinite(second.flattened)
    x, y = first.flattened[known], second.flattened[known]
    return 2 * np.cov(x, y, ddof=0)[0, 1] / (x.var() + y.var())


def scores(target, candidates, orientation, projection, metal):
    """Measures of every candidate, shape (n, 4)."""
    smoothing = projection.scale * np.radians(SMOOTHING)
    settings = ae.fit.FitSettings(smoothing=smoothing, flattening=0.0, resamples=0, allow_noise=True)
    corrected = Comparison(target, settings) if target.is_counts else None
    reference = folded(target, orientation, projection, metal)
    found = []
    for map in candidates:
        plain = float(ae.similarity(map, target, smoothing=smoothing))
        noise_free = np.nan
        if corrected is not None:
            noise_free = corrected.similarity(map.values[corrected.box].astype(float))
        each = folded(map, orientation, projection, metal)
        found.append((plain, noise_free, each.correlation(reference), concordance(each, reference)))
    return np.array(found)


def field_of_view(map, run, orientation, projection):
    """The map without the places beyond the field of view of the run."""
    x, y = np.meshgrid((map.x_edges[1:] + map.x_edges[:-1]) / 2, (map.y_edges[1:] + map.y_edges[:-1]) / 2)
    crystal = projection.directions(np.column_stack([x.ravel(), y.ravel()])) @ orientation.matrix
    inside = crystal @ crystal_of(run, orientation)[2] > np.cos(
        np.radians(run.settings["flights"]["field_of_view"] - 1.5)
    )
    mask = map.mask & inside.reshape(map.mask.shape)
    return ae.DetectorMap.from_array(np.where(mask, map.values, 0), map.x_edges, map.y_edges,
                                     is_counts=map.is_counts, mask=mask)  # fmt: skip


def measured(name, path, run_path):
    """Scores of ten rules against a measured map."""
    metal, run = METALS[name], ae.load(run_path)
    target, orientation, projection = measured_of(name, path)
    target = field_of_view(target, run, orientation, projection)
    own = projection_of(run)
    scale = float(np.median(run.at_evaporation_field().energy_scales))
    rules = rules_of_metal(name, scale)
    crystal = [directions_of(run, own, run.hits(rule), orientation) for rule in rules.values()]
    candidates = [counts_on(target, orientation, projection, each) for each in crystal]
    table = scores(target, candidates, orientation, projection, metal)
    ranks = (-table).argsort(axis=0).argsort(axis=0) + 1
    print(f"{'':24}" + " | ".join(MEASURES))
    for rule, row, rank in zip(rules, table, ranks, strict=True):
        print(f"{rule:24}" + " | ".join(f"{a:6.3f} ({b:2})" for a, b in zip(row, rank, strict=True)))


def twins(name, first_path, second_path, displaced):
    """Ranks of the true rule of ten twins."""
    metal = METALS[name]
    first, second = ae.load(first_path), ae.load(second_path)
    orientation = ae.Orientation.from_settings(second.settings["tip"])
    projection = ae.detection.Projection(100.0)
    edges = np.linspace(-45, 45, 181)
    blank = ae.DetectorMap.from_array(np.ones((180, 180)), edges, edges)
    blank = field_of_view(blank, second, orientation, projection)
    random = np.random.default_rng(1)
    shown = ae.detection.Projection(103.0 if displaced else 100.0)
    truths, other = [], projection_of(second)
    for hits in mixed_hits(second).values():
        crystal = directions_of(second, other, hits, orientation)
        chosen = random.permutation(len(crystal))[:50_000]
        truths.append(counts_on(blank, orientation, shown, crystal[chosen]))
    own = projection_of(first)
    named = mixed_hits(first)
    candidates = [
        counts_on(blank, orientation, projection, directions_of(first, own, each, orientation))
        for each in named.values()
    ]
    ranks = []
    for number, (rule, truth) in enumerate(zip(named, truths, strict=True)):
        table = scores(truth, candidates, orientation, projection, metal)
        rank = (-table).argsort(axis=0).argsort(axis=0)[number] + 1
        ranks.append(rank)
        best = [list(named)[each] for each in table.argmax(axis=0)]
        print(f"{rule:24}" + " | ".join(f"{a} ({b})" for a, b in zip(rank, best, strict=True)))
    ranks = np.array(ranks)
    print(f"{'first, mean rank':24}" + " | ".join(f"{np.sum(each == 1)}, {each.mean():.1f}" for each in ranks.T))


def main():
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("what", choices=("measured", "twins"))
    parser.add_argument("metal", choices=METALS)
    parser.add_argument("files", nargs=2)
    parser.add_argument("--displaced", action="store_true")
    options = parser.parse_args()
    warnings.simplefilter("ignore", ae.warnings.ResponseWarning)
    if options.what == "measured":
        measured(options.metal, *options.files)
    else:
        twins(options.metal, *options.files, options.displaced)


if __name__ == "__main__":
    main()
