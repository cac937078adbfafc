"""
Correction of the measured size of a precipitate
================================================

Simulated spheres of 0.7 to 1.5 nm with 50 % copper and 0.85 or 1.15 times the evaporation field of aluminium, which a
detector with an efficiency of 0.6 records. The radius of the largest cluster of the reconstruction is compared with the
true one by `compare_with_truth`. Every second simulation gives the line of `corrected`, by which the others are judged:
``python corrections.py FIELD_RATIO``, two minutes of processor time.
"""

import sys

import numpy as np

import apt_evap as ae

ALUMINIUM = ae.material("Al")
APEX, EFFICIENCY, D_MAX, N_MIN = 5.0, 0.6, 0.55, 10  # nm, nm
RADII = np.linspace(0.7, 1.5, 12)  # nm


def evaporated(radius, ratio, seed):
    """A run of a specimen with one sphere, near the axis."""
    random = np.random.default_rng(seed)
    across = random.uniform(-0.4, 0.4, 2)
    ball = ae.specimen.Sphere((*across.tolist(), APEX - 0.4 - float(radius)), float(radius))
    field = ALUMINIUM.evaporation_field
    copper = ae.material("Cu", a=ALUMINIUM.a)
    matrix = ae.specimen.Phase("matrix", ALUMINIUM, solutes={copper: 0.01}, evaporation_field=field)
    particle = ae.specimen.Phase("ball", ALUMINIUM, ball, solutes={copper: 0.5}, evaporation_field=ratio * field)
    tip = ae.Tip(
        phases=[matrix, particle], apex_radius=APEX, axis=(0, 1, 2), shank_length=APEX, offset_seed=seed, seed=seed
    )
    ions = (2 * radius + 0.9) * np.pi * APEX**2 / (ALUMINIUM.a**3 / 4)
    simulation = ae.Simulation(
        tip, seed=seed, rule=ae.ConstantPotential(), n_threads=1, detector=ae.Detector(100.0, 170.0),
        flight_settings=ae.simulation.FlightSettings(field_of_view="detector"),
    )  # fmt: skip
    return simulation.run(round(ions), [ae.Unperturbed()], responses=False, progress=False)


def measure(cloud):
    """Radius of the largest cluster [nm]."""
    clusters = cloud.clusters("Cu", D_MAX, N_MIN)
    return {"radius": clusters.radii[0] if len(clusters) else np.nan}


def main(ratio):
    instrument = ae.Instrument(100.0, 160.0, efficiency=EFFICIENCY)
    ways = {"cap": {}, "evolving": {"shape": "evolving", "solutes": ["Cu"]}}
    compared = []
    for seed, radius in enumerate(RADII, 1):
        run = evaporated(radius, ratio, seed)
        compared.append(ae.reconstruction.compare_with_truth(run, measure, instrument, reconstructions=ways, seed=seed))
        row = compared[-1].values["radius"]
        print(f"radius {radius:.2f} nm, {len(run):,} atoms: "
              + ", ".join(f"{name} {value:.2f}" for name, (value, _) in row.items()), flush=True)  # fmt: skip
    for way in ways:
        raw, mended, held = [], [], []
        for one in compared[1::2]:
            row = one.values["radius"]
            try:
                value, error = ae.reconstruction.corrected(compared[::2], "radius", row[way].value, way)
            except ValueError as reason:
                print(f"  {way}: {reason}")
                continue
            true = row["all sites"].value
            raw.append(row[way].value / true - 1)
            mended.append(value / true - 1)
            held.append(abs(value - true) <= error)
            print(f"  {way}: measured {row[way].value:.2f}, corrected {value:.2f} +/- {error:.2f}, true {true:.2f} nm")
        rms = [100 * np.sqrt(np.mean(np.square(part))) for part in (raw, mended)]
        print(f"{way}: RMS error {rms[0]:.0f} % as measured, {rms[1]:.0f} % corrected; held {sum(held)} of {len(held)}")


if __name__ == "__main__":
    main(float(sys.argv[1]))
