"""Twin experiment: hidden energies, rotation, scale and shift are recovered from a map alone.

    python articles/hidden_energies/twin.py RUN.h5 OTHER.h5

RUN and OTHER are runs of tips with the same shape, but different origins of the lattice (Tip(offset_seed=...)) and
different seeds. They have no ions in common. The measured map comes from OTHER, with as many draws of its ions as
needed.
"""

import argparse
import time
from dataclasses import replace
from pathlib import Path

import numpy as np

import apt_evap as ae

HIDDEN = {
    "roll-up": ae.RollUp(ae.TruncatedNormal(0.155, 0.155)),
    "lateral": ae.LateralVelocity(ae.TruncatedNormal(0.3, 0.316 * 0.3)),
}


def measured_map(run, perturbation, instrument, centre, radius, ions, bins):
    """Map of the first `ions` hits in a circle, in the frame of the instrument, and the number of draws."""
    x, y = [], []
    seed, n_hits = 1000, 0
    while n_hits < ions:
        hits = instrument.hits(replace(run, seed=seed).hits(perturbation)).within_circle(radius, centre)
        x, y, seed, n_hits = [*x, hits.x], [*y, hits.y], seed + 1, n_hits + len(hits)
    hits = ae.Hits(x=np.concatenate(x)[:ions], y=np.concatenate(y)[:ions])
    return hits.map(bins), seed - 1000


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("run")
    parser.add_argument("other")
    parser.add_argument("--ions", type=int, default=200_000)
    parser.add_argument("--bins", type=int, default=96)
    parser.add_argument(
        "--radius", type=float, default=60.0, help="radius of the field of view [mm], in the frame of the simulation"
    )
    parser.add_argument("--mechanism", choices=HIDDEN, action="append")
    parser.add_argument("-o", "--output", type=Path, help="folder for figures and JSON files")
    options = parser.parse_args()
    run, other = ae.load(options.run), ae.load(options.other)
    scale = 0.4
    instrument = ae.Registration(rotation=17.0, scale=scale, shift=(3.0, -2.0))
    centre = instrument.points(np.array(0.25 * options.radius), np.array(-0.15 * options.radius))  # off the axis
    for mechanism in options.mechanism or HIDDEN:
        measured, draws = measured_map(
            other, HIDDEN[mechanism], instrument, centre, scale * options.radius, options.ions, options.bins
        )
        print(f"\n{mechanism}: {HIDDEN[mechanism]}, {draws} draws of {len(other):,} ions\n{measured}", flush=True)
        start = time.perf_counter()
        settings = ae.fit.FitSettings(objective="similarity")
        study = ae.fit_energies(run, measured, ae.fit.EnergyGrid(mechanism), settings)
        print(f"{study}\nthe optimum is better than the unperturbed map in {study.gain_share:.0%} of the resamples")
        print(f"{study.registration}; true {instrument}\n{time.perf_counter() - start:.0f} s")
        print(np.array2string(study.scores[0], precision=3, suppress_small=True))
        if options.output:
            options.output.mkdir(exist_ok=True)
            study.save(options.output / f"{mechanism}.json")
            ae.plot.score_matrix(study)[0].figure.savefig(options.output / f"{mechanism}_scores.png")
            ae.plot.side_by_side(study)[0].figure.savefig(options.output / f"{mechanism}_maps.png")


if __name__ == "__main__":
    main()
