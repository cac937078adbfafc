"""A nickel tip along [111], evaporated once and seen under four perturbations.

Writes ni111_perturbations.h5 and .png, and ni111_rollup.epos, into the current folder. `python quickstart.py 500`
evaporates 500 atoms instead of 15,000.
"""

import sys

import apt_evap as ae

n_ions = int(sys.argv[1]) if len(sys.argv) > 1 else 15_000

nickel = ae.material("Ni")
tip = ae.Tip(nickel, apex_radius=20 * nickel.a, axis=(1, 1, 1), shank_length=20 * nickel.a)
simulation = ae.Simulation(tip, voltage=1000.0, seed=1, detector=ae.Detector(distance=100.0, width=300.0))
run = simulation.run(n_ions)
run.save("ni111_perturbations.h5")

# the energies that Shaikh et al., arXiv 2509.13744, find for nickel
energy = ae.TruncatedNormal(mean=0.155, standard_deviation=0.155)
perturbations = {
    "unperturbed": ae.Unperturbed(),
    "lateral velocity": ae.LateralVelocity(energy),
    "roll-up": ae.RollUp(energy),
    "3/4 roll-up, 1/4 lateral": ae.Combined(energy, rollup_fraction=0.75),
}
maps = []
for name, perturbation in perturbations.items():
    hits = run.hits(perturbation)
    print(f"{name}: {hits}")
    maps.append(hits.map(bins=160, extent=(-150, 150, -150, 150), quantum=None).smoothed(2.0))
ae.plot.detector_maps(maps, list(perturbations))[0].figure.savefig("ni111_perturbations.png")

ae.write("ni111_rollup.epos", run.hits(ae.RollUp(energy)))  # with a warning that counts the ions that missed
print(ae.read("ni111_rollup.epos"))
emitter = simulation.emitter
print(f"{len(emitter):,} surface atoms left, fields {emitter.fields.min():.1f} to {emitter.fields.max():.1f} V/nm")
