"""
3. Fit the energies
===================

From a measured map to the energies of the emission: bring a simulated map onto it, compare for many energies, and read
off the best ones with their errors.

``python tutorial_3_fit_energies.py 2000`` evaporates 2,000 atoms of each of two smaller tips instead of 15,000. A
measurement of yours takes the place of the one made here: ``measured = ae.read("R5083.epos")``.
"""

import sys

import apt_evap as ae

n_ions = int(sys.argv[1]) if len(sys.argv) > 1 else 15_000
size, bins = (20, 48) if n_ions >= 5_000 else (10, 24)  # radius in lattice constants; bins across the measured map
n_ions = max(n_ions, 1_500)  # fewer show no pattern to register
nickel = ae.material("Ni")


def evaporate(offset_seed, seed):
    """A run of a tip along [111], the origin of the lattice and the ties of the events as the seeds say."""
    tip = ae.Tip(
        nickel,
        apex_radius=size * nickel.a,
        axis=(1, 1, 1),
        shank_length=2 * size * nickel.a,
        depth=6 * nickel.a,
        offset_seed=offset_seed,
    )
    return ae.Simulation(tip, seed=seed).run(n_ions)


# %%
# A measurement whose energies are known shows what the fit can find. It is another specimen, of which no ion is one of
# the run that is fitted: rolled up with a hidden energy, turned by 17 degrees, shrunk to the detector of an instrument,
# off its centre, and cut off by the circle of the field of view.

hidden = ae.RollUp(ae.TruncatedNormal(mean=0.155, standard_deviation=0.155))
instrument = ae.Registration(rotation=17.0, scale=0.3, shift=(2.0, -1.0))
measured = instrument.hits(evaporate(offset_seed=5, seed=2).hits(hidden)).within_circle(18.0)
print(measured)

# %%
# One run serves all energies, since its responses give the hits of every ion for any of them.

run = evaporate(offset_seed=1, seed=1)
print(run)

# %%
# Registration: where the simulated map lies on the measured one. Any energy of the right order does. A [111] axis has
# three such places, and three mirrored ones, alike but for noise: what fits as well is in ``ties``. Always look at the
# overlay.

guess = run.hits(ae.RollUp(0.1)).map(bins=2 * bins, quantum=None)
seen = measured.map(bins=bins, quantum=None)
registration = ae.register(guess, seen)
print(f"{registration}, correlation {registration.score:.2f}, {len(registration.ties)} ties")
ae.plot.overlay(guess, seen.smoothed(0.6), registration).figure.savefig("overlay.png")

# %%
# What is compared: both maps on the same bins, where both show something; each divided by itself, smoothed broadly, so
# that gradients across the detector do not count, and smoothed by half a bin. Their structural similarity (SSIM) is 1
# for equal maps and 0 for maps that have nothing in common. The noise of both is known and allowed for: the true
# energies have about 1, give or take the error, although no two noisy maps are equal. Here a part of the grid of
# energies will do; without ``means`` and ``rsds`` it is that of :cite:t:`Shaikh`.

study = ae.fit_energies(
    run,
    seen,
    mechanism="roll-up",
    means=(0.01, 0.0825, 0.155, 0.2275, 0.3),
    rsds=(0.0316, 0.1, 0.316, 1.0, 3.16),
    registration=registration,
    resamples=100,
)
print(study)

# %%
# The framed energies are the best on the grid, the circle is the best place between its points.

ae.plot.ssim_matrix(study)[0].figure.savefig("ssim.png")

# %%
# What the errors mean. All ions, measured and simulated, are drawn anew, with replacement, 100 times, and everything is
# computed again: ± is the standard deviation, the bars hold 95 % of the best places. So they say what another
# measurement of as many ions would have given. They do not hold what is wrong in the model: the shape of the specimen,
# the registration, a mechanism that is not that of the metal. Whether to believe the optimum, two numbers tell: by how
# much it is better than the unperturbed map, and how far it stays below 1. With the noise, which ``plain`` has, a good
# model reaches more than two random halves of the measured ions do, since each of them has the noise of half the ions.
#
# A mean and a width of the distribution make up for each other. The mean of the energies that ions really have, those
# above 0, is found better than either.

found = study.refined
print(f"mean of the energies {found.bounded('true_mean')} eV, hidden {hidden.energy.true_mean:.3g} eV")
print(f"better than unperturbed by {study.gain}, in {study.gain_share:.0%} of the resamples")
print(f"SSIM {study.optimum.score}; uncorrected {study.plain['optimum']}, two halves {study.ceiling}")

# %%
# The maps, as they are compared, and their middle magnified.

ae.plot.side_by_side(study)[0].figure.savefig("maps.png")
study.save("study.json")
