"""Energy of hops in a running simulation: V dQ/2 for atoms that are moved, by a solve of the charges around them.

    python hops.py RUNS W 80 --hops 300              # writes RUNS/W_80_hops.npz
    python hops.py RUNS W 20 --check 20              # the same energies by whole dense solves
    python hops.py RUNS --sphere                     # an atom above a sphere, against its image charge

For each event the charges within `PATCH` nearest neighbour distances are solved three times: with the atom at its site,
above its strongest neighbour, and at the vacant sites above the step next to that neighbour. Everything is kept at the
voltage of the simulation; `shares.py` scales it to a field.
"""

import argparse
from pathlib import Path

import numpy as np
from scipy.spatial import cKDTree

import apt_evap as ae
from apt_evap.specimen.lattice import COORDINATION

AXES = {
    "W": (0, 1, 1), "Ni": (1, 1, 1), "Al": (1, 1, 1), "Cu": (1, 1, 1), "Mg": (0, 0, 0, 1), "Fe": (0, 0, 1),
    "Pt": (0, 0, 1),
}  # fmt: skip
PATCH = 6.0  # nearest neighbour distances
UPWARD = 0.3  # of these: a vacant site this much above the site of the atom, along its normal, is one of an adatom
NEAREST = 12
"""Atoms whose potential is taken for that of the conductor.

Between two relaxations the potential of all atoms drifts by some 1e-4. That changes all charges by as much, but at
R = 80 a an atom misses only 1 % of the potential, so its charge would be wrong by some per cent.
"""
K = ae.units.COULOMB


class Conductor:
    """The charged surface without the atom that has just left."""

    def __init__(self, emitter, own):
        self.emitter, self.own = emitter, own
        self.positions, self.charges = emitter.positions, emitter.charges

    def energies(self, centre, places, reach=PATCH):
        """Charge [e], and energy q (V - phi_0)/2 [eV], of an atom put at each of some places near a centre."""
        d = self.emitter.tip.nearest_neighbour_distance
        near = np.flatnonzero(np.linalg.norm(self.positions - centre, axis=1) < reach * d)
        atoms = self.positions[near]
        distances = np.linalg.norm(atoms[:, None] - atoms[None], axis=2)
        np.fill_diagonal(distances, 1.0)
        matrix = K / distances
        np.fill_diagonal(matrix, self.own)
        coupling = K / np.linalg.norm(places[:, None] - atoms[None], axis=2)
        effective = self.own - np.einsum("ij,ji->i", coupling, np.linalg.solve(matrix, coupling.T))
        voltage = np.mean(
            [
                self.potential(self.positions[atom]) + self.own * self.charges[atom]
                for atom in near[np.argsort(np.linalg.norm(atoms - centre, axis=1))[:NEAREST]]
            ]
        )
        missing = voltage - np.array([self.potential(place) for place in places])
        return missing / effective, 0.5 * missing**2 / effective

    def potential(self, place):
        """Potential of all atoms, without one at the place itself [V]."""
        distances = np.linalg.norm(self.positions - place, axis=1)
        distances[distances < 1e-9] = np.inf
        return K * np.sum(self.charges / distances)

    def by_dense_solves(self, places):
        """The same energies as V (Q' - Q)/2 from the whole matrix with and without the atom [eV]."""
        n = len(self.positions)
        matrix = np.empty((n, n))
        for row in range(n):
            distances = np.linalg.norm(self.positions - self.positions[row], axis=1)
            distances[row] = 1.0
            matrix[row] = K / distances
            matrix[row, row] = self.own
        before = np.linalg.solve(matrix, np.full(n, self.emitter.voltage)).sum()
        gains = []
        for place in places:
            larger = np.empty((n + 1, n + 1))
            larger[:n, :n] = matrix
            larger[n, :n] = larger[:n, n] = K / np.linalg.norm(self.positions - place, axis=1)
            larger[n, n] = self.own
            gains.append(
                0.5
                * self.emitter.voltage
                * (np.linalg.solve(larger, np.full(n + 1, self.emitter.voltage)).sum() - before)
            )
        return np.array(gains)


class Lattice:
    """Sites around an atom, and which of them are empty."""

    def __init__(self, tip):
        self.tip, self.tree = tip, cKDTree(tip.positions)
        self.bond = tip.bond_length
        self.present = np.ones(len(tip.positions), bool)
        full = COORDINATION[tip.elements[0].structure][0]
        self.steps = []  # to the nearest neighbours; two lists for hcp and diamond
        low = tip.positions[:, 2] < np.percentile(tip.positions[:, 2], 90)
        for atom in np.flatnonzero(low)[:: max(1, low.sum() // 400)]:
            near = [other for other in self.tree.query_ball_point(tip.positions[atom], self.bond) if other != atom]
            steps = tip.positions[near] - tip.positions[atom]
            if len(near) == full and not any(same(steps, known) for known in self.steps):
                self.steps.append(steps)

    def neighbours(self, place):
        """Present atoms within a bond of a place."""
        near = np.array(self.tree.query_ball_point(place, self.bond), dtype=int)
        near = near[self.present[near]]
        return near[np.linalg.norm(self.tip.positions[near] - place, axis=1) > 1e-6]

    def vacant(self, atom):
        """Empty lattice sites next to a present atom."""
        start = self.tip.positions[atom]
        seen = self.tip.positions[self.neighbours(start)] - start
        steps = min(self.steps, key=lambda steps: sum(np.linalg.norm(steps - one, axis=1).min() for one in seen))
        sites = start + steps
        free = [not self.present[self.tree.query_ball_point(site, 1e-3)].any() for site in sites]
        return sites[np.array(free)]


def sphere(reach):
    """Print energies of an atom above a sphere of atoms over those by the image charge, for some heights [nm].

    An atom with the self term S at the distance r from the centre of a sphere with the radius R at the potential V has
    the energy (V - V R/r)^2 / (2 (S - k R/(r^2 - R^2))).
    """
    radius, n, voltage = 5.0, 4000, 200.0
    k = np.arange(n) + 0.5
    z, turn = 1.0 - 2.0 * k / n, k * np.pi * (1.0 + 5.0**0.5)
    across = np.sqrt(1.0 - z * z)
    positions = radius * np.column_stack([across * np.cos(turn), across * np.sin(turn), z])
    area = 4.0 * np.pi * radius**2 / n
    own = 3.92 / area**0.5 * K
    matrix = K / np.maximum(np.linalg.norm(positions[:, None] - positions[None], axis=2), 1e-9)
    np.fill_diagonal(matrix, own)

    class Sphere:
        """What `Conductor` needs of an emitter."""

        tip = type("Tip", (), {"nearest_neighbour_distance": (2.0 / 3.0**0.5 * area) ** 0.5})

    emitter = Sphere()
    emitter.positions, emitter.charges = positions, np.linalg.solve(matrix, np.full(n, voltage))
    heights = np.array([0.3, 0.5, 0.8])
    places = np.array([0.0, 0.0, 1.0]) * (radius + heights)[:, None]
    r = radius + heights
    image = (voltage - voltage * radius / r) ** 2 / (2.0 * (own - K * radius / (r * r - radius * radius)))
    for name, energies in (
        ("patch", Conductor(emitter, own).energies(np.array([0.0, 0.0, radius]), places, reach)[1]),
        ("image charge", image),
    ):
        print(name, energies.round(4), "over that of the image charge", (energies / image).round(4))


def same(steps, known):
    """Whether two lists of vectors are the same."""
    return all(np.linalg.norm(known - one, axis=1).min() < 1e-6 for one in steps)


def self_term(emitter):
    """Potential of an atom by its own charge [V/e]."""
    positions, charges = emitter.positions, emitter.charges
    chosen = np.argsort(charges)[:: max(1, len(charges) // 40)]
    others = []
    for atom in chosen:
        distances = np.linalg.norm(positions - positions[atom], axis=1)
        distances[atom] = np.inf
        others.append(K * np.sum(charges / distances))
    return -float(np.polyfit(charges[chosen], others, 1)[0])  # others = V - S q


def hops(metal, radius, number, skip, seed=1, check=0, stride=7):
    """Numbers of `number` hops, as a dict of arrays."""
    material = ae.material(metal)
    size = radius * material.a
    tip = ae.Tip(material, size, axis=AXES[metal], shank_length=size, depth=8 * material.a, offset_seed=seed)
    emitter = ae.evaporation.Emitter(tip, rule=ae.ConstantPotential(), n_threads=1)
    lattice, own = Lattice(tip), self_term(emitter)
    for batch in emitter.advance(skip):
        lattice.present[batch.site] = False
    cap = emitter.cap
    rows, count = [], 0
    for event in emitter.advance(200 * number, batch_size=1):
        if len(event) == 0:
            continue
        lattice.present[event.site] = False
        count += 1
        site, normal, target = tip.positions[event.site[0]], event.normals[0], event.targets[0, 0]
        away = np.degrees(np.arctan2(np.hypot(*site[:2]), site[2] - cap.apex + cap.radius))
        if count % stride or target < 0 or event.detached[0] or away > 40.0:
            continue
        above = tip.positions[target] + tip.nearest_neighbour_distance * normal
        hollows = lattice.vacant(target)
        height = (hollows - site) @ normal
        hollows = hollows[height > UPWARD * tip.nearest_neighbour_distance]
        conductor = Conductor(emitter, own)
        places = np.vstack([site[None], above[None], hollows])
        charges, energies = conductor.energies(site, places)
        bonds = [len(lattice.neighbours(place)) for place in places]
        if check and len(rows) < check:
            dense = conductor.by_dense_solves(places)
            print(len(emitter), "atoms, energies [eV]", energies.round(4), "dense", dense.round(4), flush=True)
        # the adatom site with the most bonds, and of these the one with the largest charge
        order = sorted(range(2, len(places)), key=lambda i: (bonds[i], charges[i]))
        hollow = order[-1] if order else -1
        rows.append({
            "site_charge": charges[0], "event_charge": event.charges[0], "field": event.fields[0],
            "ratio": event.target_charges[0, 0] / event.charges[0], "bonds": bonds[0],
            "site_energy": energies[0], "above_charge": charges[1], "above_energy": energies[1],
            "above_bonds": bonds[1],
            "hollow_charge": charges[hollow] if order else np.nan,
            "hollow_energy": energies[hollow] if order else np.nan, "hollow_bonds": bonds[hollow] if order else 0,
            "away": away,
        })  # fmt: skip
        if len(rows) == number:
            break
    arrays = {name: np.array([row[name] for row in rows]) for name in rows[0]}
    return arrays | {"cap_field": emitter.cap.field, "voltage": emitter.voltage, "self_term": own, "radius": cap.radius}


def main():
    """Write the file of one metal and radius."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("runs", type=Path)
    parser.add_argument("metal", choices=AXES, nargs="?")
    parser.add_argument("radius", type=int, nargs="?", help="in lattice constants")
    parser.add_argument("--sphere", action="store_true", help="only the check against an image charge")
    parser.add_argument("--hops", type=int, default=300)
    parser.add_argument("--skip", type=int, help="events before; by default a fifth of a layer")
    parser.add_argument("--check", type=int, default=0, help="compare so many hops with whole dense solves")
    options = parser.parse_args()
    if options.sphere:
        sphere(PATCH)
        return
    skip = 3 * options.radius**2 if options.skip is None else options.skip
    options.runs.mkdir(parents=True, exist_ok=True)
    arrays = hops(options.metal, options.radius, options.hops, skip, check=options.check)
    np.savez(options.runs / f"{options.metal}_{options.radius}_hops.npz", **arrays)
    gain = arrays["above_energy"] - arrays["site_energy"]
    print(options.metal, options.radius, "site over cap", (arrays["field"].mean() / arrays["cap_field"]).round(3),
          "solved over event charge", (arrays["site_charge"] / arrays["event_charge"]).mean().round(4),
          "gain at 1000 V", np.percentile(gain, [10, 50, 90]).round(3))  # fmt: skip


if __name__ == "__main__":
    main()
