"""
3. Fit the energies
===================

Determine emission energies from a measured map: register a simulated map, compare maps for many energies, and find the
best energies with their errors.

The script evaporates 15,000 atoms of each of two tips. ``python tutorial_3_fit_energies.py 2000`` evaporates 2,000
atoms of two smaller tips. To use your own measurement, replace the simulated one by ``measured =
ae.read("R5083.epos")``.
"""

import sys

import apt_evap as ae

n_ions = int(sys.argv[1]) if len(sys.argv) > 1 else 15_000
size, bins = (20, 48) if n_ions >= 5_000 else (10, 24)  # radius in lattice constants; bins across the measured map
n_ions = max(n_ions, 1_500)  # with fewer ions, there is no pattern to register
nickel = ae.material("Ni")


def evaporate(offset_seed, seed):
    """Run of a tip along [111]; the seeds set the origin of the lattice and the random numbers of the perturbations."""
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
# A simulated measurement with known energies shows what the fit can determine. It is another specimen, with no ions in
# common with the fitted run. Its ions roll up with a hidden energy. Its map is rotated by 17 degrees, scaled to the
# detector of an instrument, shifted from its centre, and limited to a circular field of view.

truth = ae.RollUp(ae.TruncatedNormal(mean=0.155, standard_deviation=0.155))
instrument = ae.Registration(rotation=17.0, scale=0.3, shift=(2.0, -1.0))
measured = instrument.hits(evaporate(offset_seed=5, seed=2).hits(truth)).within_circle(18.0)
print(measured)

# %%
# One run is sufficient for all energies, because the responses give the hits of every ion for any energy.

run = evaporate(offset_seed=1, seed=1)
print(run)

# %%
# Registration finds the rotation, scale and shift between the simulated and the measured map. An approximate energy is
# sufficient for this step. For a [111] axis, there are three equivalent registrations, and three mirrored ones, which
# differ only by noise. Equally good registrations are in ``ties``. Always check the overlay.

guess = run.hits(ae.RollUp(0.1)).map(bins=2 * bins, position_step=None)
measured_map = measured.map(bins=bins, position_step=None)
registration = ae.register(guess, measured_map)
print(f"{registration}, correlation {registration.score:.2f}, {len(registration.ties)} ties")
ae.plot.overlay(guess, measured_map.smoothed(0.6), registration).figure.savefig("overlay.png")

# %%
# Both maps are compared on the same bins, in the region that both cover. Each map is divided by a strongly smoothed
# copy of itself, which removes gradients across the detector, and smoothed by half a bin. Then both are folded about
# the pole by its symmetry, which averages six parts of this map. Their concordance is 1 for equal lines of equal
# contrast and 0 for unrelated maps. It is corrected for the noise of both maps, which is known. For the true energies,
# it is therefore about 1 within the error, although two noisy maps are never equal. In this example, a small grid of
# energies is sufficient. Without ``means`` and ``relative_spreads``, the grid is that of :cite:t:`Shaikh`.

grid = ae.fit.EnergyGrid(
    "roll-up", means=(0.01, 0.0825, 0.155, 0.2275, 0.3), relative_spreads=(0.0316, 0.1, 0.316, 1.0, 3.16)
)
study = ae.fit_energies(run, measured_map, grid, ae.fit.FitSettings(resamples=100), registration=registration)
print(study)

# %%
# The frame shows the best energies on the grid, and the circle shows the interpolated optimum.

ae.plot.score_matrix(study)[0].figure.savefig("scores.png")

# %%
# The errors come from 100 resamples of all measured and simulated ions, for which the analysis is repeated. The value
# after ± is the standard deviation: how much the result of another measurement with the same number of ions would
# differ. The intervals are wider: they contain all energies whose score is below the best one by less than an allowance
# for specimens that differ from the simulated one (``model_error``), and they follow the ridge of equal true means. An
# interval that ends at the end of the grid says "at most" or "at least". They do not include a mechanism that does not
# apply to the metal. Two numbers show whether the optimum is credible: its gain over the unperturbed map, and its
# difference from 1. The uncorrected concordance is in ``plain``. For a good model, it is higher than that of two random
# halves of the measured ions, because each half has the noise of half the ions.
#
# The mean and the width of the distribution can compensate each other. The true mean, that is, the mean of the energies
# after truncation at 0, is determined better than both.

optimum = study.refined
print(f"mean of the energies {optimum.bounded('true_mean')} eV, hidden {truth.energy.true_mean:.3g} eV")
print(f"better than unperturbed by {study.gain}, in {study.gain_share:.0%} of the resamples")
score = study.settings.score_name
print(f"{score} {study.optimum.score}; uncorrected {study.plain['optimum']}, two halves {study.ceiling}")

# %%
# The compared maps, and their central part magnified.

ae.plot.side_by_side(study)[0].figure.savefig("maps.png")
study.save("study.json")
