"""The charge of an atom after a roll-up over that before: one patch solve for each event.

    python migration.py Ni 80
    python migration.py W 80

The atom that has left is put back onto its strongest neighbour. The charges within 2 nm of its site and its own are
solved at the potential of the specimen, with all other charges fixed. The line over the charge ratio of the strongest
neighbour is the one of `ae.emission.Migration`.
"""

import argparse

import numpy as np

import apt_evap as ae

AXES = {"W": (0, 1, 1), "Ni": (1, 1, 1), "Al": (1, 1, 1)}
PATCH = 2.0  # nm


def self_term(emitter):
    """Potential of an atom by its own charge over that charge [V/e], and the potential of the specimen [V]."""
    positions, charges = emitter.positions, emitter.charges
    n = len(charges)
    chosen = np.unique(np.concatenate([np.argsort(charges)[:: n // 40], [np.argmin(charges), np.argmax(charges)]]))
    others = np.empty(len(chosen))
    for row, atom in enumerate(chosen):
        distances = np.linalg.norm(positions - positions[atom], axis=1)
        distances[atom] = np.inf
        others[row] = ae.units.COULOMB * np.sum(charges / distances)
    slope, potential = np.polyfit(charges[chosen], others, 1)  # others = V - S q
    return -slope, potential


def after_roll(emitter, event, own, potential):
    """Charge [e], and twice the field of all other charges along the normal [V/nm], on the strongest neighbour.

    Parameters
    ----------
    emitter : Emitter
        Just after the event.
    event : Batch
        Of this one event.
    own, potential : float
        See `self_term`.
    """
    tip, normal = emitter.tip, event.normals[0]
    target = tip.positions[event.targets[0, 0]] + tip.nearest_neighbour_distance * normal
    positions = emitter.positions
    near = positions[np.linalg.norm(positions - tip.positions[event.site[0]], axis=1) < PATCH]
    distances = np.linalg.norm(near[:, None] - near[None], axis=2)
    np.fill_diagonal(distances, 1.0)
    matrix = ae.units.COULOMB / distances
    np.fill_diagonal(matrix, own)
    step = target - near
    away = np.linalg.norm(step, axis=1)
    coupling = ae.units.COULOMB / away
    induced = -np.linalg.solve(matrix, coupling)  # by a charge of 1 at the target
    missing = potential - float(emitter.potential_at(target[None], 0.2)[0])
    charge = missing / (own + coupling @ induced)
    field = emitter.field_at(target[None], 0.2)[0]
    field = field + ae.units.COULOMB * ((charge * induced / away**3)[:, None] * step).sum(axis=0)
    return charge, 2.0 * float(field @ normal)


def rolled(metal, radius, events, skip, seed=1):
    """Charge ratio of the strongest neighbour, ratio of the charges and of the fields after the roll-up, each event."""
    material = ae.material(metal)
    size = radius * material.a
    tip = ae.Tip(material, size, axis=AXES[metal], shank_length=size, depth=8 * material.a, offset_seed=seed)
    emitter = ae.evaporation.Emitter(tip, rule=ae.ConstantPotential(), n_threads=1)
    own, potential = self_term(emitter)
    for _ in emitter.advance(skip):
        pass
    found = []
    for event in emitter.advance(20 * events, batch_size=1):
        if len(event) == 0 or event.targets[0, 0] < 0:
            continue
        if tip.positions[event.site[0], 2] < emitter.positions[:, 2].max() - 0.25 * size:
            continue  # within about 40 degrees of the apex
        charge, field = after_roll(emitter, event, own, potential)
        ratio = event.target_charges[0, 0] / event.charges[0]
        found.append((ratio, charge / event.charges[0], field / event.fields[0]))
        if len(found) == events:
            break
    return np.array(found)


def main():
    """Print the lines."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("metal", choices=AXES)
    parser.add_argument("radius", type=int, help="in lattice constants")
    parser.add_argument("--events", type=int, default=500)
    parser.add_argument("--skip", type=int, default=20_000)
    options = parser.parse_args()
    ratio, charges, fields = rolled(options.metal, options.radius, options.events, options.skip).T
    print(f"charge ratio of the strongest neighbour: {np.percentile(ratio, [10, 50, 90]).round(2)}")
    for name, values in (("charge", charges), ("field of the others", fields)):
        slope, start = np.polyfit(ratio, values, 1)
        rest = np.std(values - start - slope * ratio)
        print(
            f"{name} after over before: {np.percentile(values, [10, 50, 90]).round(2)}, {start:.3f} + {slope:.3f} x, "
            f"RMS {rest:.3f}, correlation {np.corrcoef(ratio, values)[0, 1]:.2f}"
        )


if __name__ == "__main__":
    main()
