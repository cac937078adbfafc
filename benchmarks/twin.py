"""A twin experiment: hidden energies, rotation, scale and shift, found again from the map alone.

    python benchmarks/twin.py RUN.h5 OTHER.h5

RUN and OTHER are runs of one kind of tip with different origins of the lattice (Tip(offset_seed=...)) and seeds: no ion
of one is in the other. The measured map is made of OTHER, from as many draws of its ions as it takes.
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


def measured_map(run, perturbation, turned, centre, radius, ions, bins):
    """Map of a circle off the centre of the turned hits; the first `ions` that fall into it."""
    x, y = [], []
    seed, found = 1000, 0
    while found < ions:
        hits = turned.hits(replace(run, seed=seed).hits(perturbation)).within_circle(radius, centre)
        x, y, seed, found = [*x, hits.x], [*y, hits.y], seed + 1, found + len(hits)
    hits = ae.Hits(x=np.concatenate(x)[:ions], y=np.concatenate(y)[:ions])
    return hits.map(bins), seed - 1000


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("run")
    parser.add_argument("other")
    parser.add_argument("--ions", type=int, default=200_000)
    parser.add_argument("--bins", type=int, default=96)
    parser.add_argument("--radius", type=float, default=60.0, help="of the circle seen, in mm of the simulation")
    parser.add_argument("--mechanism", choices=HIDDEN, action="append")
    parser.add_argument("-o", "--output", type=Path, help="folder for pictures and JSON")
    options = parser.parse_args()
    run, other = ae.load(options.run), ae.load(options.other)
    scale = 0.4
    turned = ae.Registration(rotation=17.0, scale=scale, shift=(3.0, -2.0))
    centre = turned.points(np.array(0.25 * options.radius), np.array(-0.15 * options.radius))  # off the axis
    for mechanism in options.mechanism or HIDDEN:
        measured, draws = measured_map(
            other, HIDDEN[mechanism], turned, centre, scale * options.radius, options.ions, options.bins
        )
        print(f"\n{mechanism}: {HIDDEN[mechanism]}, {draws} draws of {len(other):,} ions\n{measured}", flush=True)
        began = time.perf_counter()
        study = ae.fit_energies(run, measured, mechanism)
        print(f"{study}\nthe optimum is better than the unperturbed map in {study.gain_share:.0%} of the resamples")
        found = study.registration
        print(f"{found}; true {turned}\n{time.perf_counter() - began:.0f} s")
        print(np.array2string(study.ssim[0], precision=3, suppress_small=True))
        if options.output:
            options.output.mkdir(exist_ok=True)
            study.save(options.output / f"{mechanism}.json")
            ae.plot.ssim_matrix(study)[0].figure.savefig(options.output / f"{mechanism}_ssim.png")
            ae.plot.side_by_side(study)[0].figure.savefig(options.output / f"{mechanism}_maps.png")


if __name__ == "__main__":
    main()
