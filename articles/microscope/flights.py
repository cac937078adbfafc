"""
Flights through atoms and boundary elements
===========================================

Tests the lens behind which a run is shown. Ions fly from the atoms of a simulated cap twice: in free space, through the
charges of all surface atoms of the specimen, and in an instrument, through the charges of the atoms of the cap and of
rings that form the rest of the shank and the electrode, in equilibrium with each other. The second flights are compared
with those that `RunLens` makes of the first.

    python flights.py --radius 20 --ions 200
"""

import argparse
import math
import time

import numpy as np
import scipy

import apt_evap as ae
from apt_evap.detection.microscope.boundary_elements import ChargedPanels, Panels, joined, ring_potential
from apt_evap.detection.microscope.conductors import electrode, graded
from apt_evap.detection.microscope.run_lens import RadiusHistory, RunLens

MASS, CHARGE, LENGTH = 58.69, 2, 90.0  # Da, e, mm
GROWTH = 0.06  # of the panels of the shank


def surface(radius, shank, events, seed):
    """Emitter of Ni[111] at constant potential after some events; radius in lattice constants, shank in degrees."""
    nickel = ae.material("Ni")
    tip = ae.Tip(nickel, radius * nickel.a, axis=(1, 1, 1), shank_angle=shank, offset_seed=seed)
    emitter = ae.evaporation.Emitter(tip, rule=ae.ConstantPotential(law_field="charge"))
    for _ in emitter.advance(events):
        pass
    return emitter


class Atoms:
    """Point charges [e], whose potential has the unit of the applied voltage."""

    def __init__(self, positions, charges, voltage):
        self.positions, self.charges = positions, charges * ae.units.COULOMB / voltage

    def field(self, places, without):
        """Potential and field at places (n, 3); each ion flies in the field of all atoms but its own."""
        potential, field = np.empty(len(places)), np.empty((len(places), 3))
        for ion, (place, own) in enumerate(zip(places, without, strict=True)):
            step = place - self.positions
            inverse = 1 / np.sqrt(np.maximum((step**2).sum(axis=1), 1e-12))
            weighted = self.charges * inverse
            weighted[own] = 0.0
            potential[ion] = weighted.sum()
            weighted *= inverse * inverse
            field[ion] = weighted @ step
        return potential, field


class Rings:
    """Shank below the atoms and electrode, about the axis; the apex of the cap is at `apex`."""

    def __init__(self, panels, apex):
        self.panels, self.apex, self.charged = panels, apex, None

    def in_presence_of(self, atoms):
        """Solve the charges in the potential of the atoms, averaged over the azimuth."""
        middles = self.panels.places(np.zeros(1))[:, 0]
        rho, z = np.hypot(*atoms.positions[:, :2].T), atoms.positions[:, 2] - self.apex
        given = np.array([ring_potential(*middle, rho, z) @ atoms.charges for middle in middles])
        self.charged = ChargedPanels(self.panels._replace(potentials=self.panels.potentials - given))

    def field(self, places):
        rho = np.hypot(places[:, 0], places[:, 1])
        potential, radial, axial = self.charged.fields(rho, places[:, 2] - self.apex)
        across = places[:, :2] * np.divide(radial, rho, out=np.zeros_like(rho), where=rho > 0)[:, None]
        return potential, np.column_stack([across, axial])


def in_instrument(emitter, lens, cap, cut):
    """Atoms of the cap and rings, in equilibrium: charges by blocks, until they do not change."""
    keep = emitter.positions[:, 2] > cap.apex - cap.radius * (1 + cut)
    positions = emitter.positions[keep]
    n = len(positions)
    self_term = float(np.ravel(emitter.state().rule_state["self_term"])[0])
    matrix, single = np.empty((n, n), np.float32), positions.astype(np.float32)
    for row, place in enumerate(single):
        distance = np.sqrt(((single - place) ** 2).sum(axis=1))
        distance[row] = 1.0
        matrix[row] = 1 / distance
        matrix[row, row] = self_term
    angle = math.radians(lens.shank_angle)
    sin, cos = math.sin(angle), math.cos(angle)
    depth = -cap.radius * (1 + cut)
    top = np.array([cap.radius / cos + (-cap.radius - depth) * sin / cos, depth])
    path = np.array([top, top + lens.shank_length * np.array([sin, -cos])])
    points = graded(path, 0.1 * cap.radius, GROWTH)
    shank = Panels(points[:-1], points[1:], np.full(len(points) - 1, np.nan), np.ones(len(points) - 1))
    rings = Rings(joined(shank, electrode(lens.distance, lens.aperture, math.radians(lens.electrode_angle))), cap.apex)
    charges, change = np.full(n, 1e-3), 1.0
    while change > 1e-5:
        rings.in_presence_of(Atoms(positions, charges, ae.units.COULOMB))
        goal = 1 - rings.field(positions)[0]
        new, _ = scipy.sparse.linalg.cg(matrix, goal.astype(np.float32), charges.astype(np.float32), rtol=3e-6)
        change = float(np.abs(new - charges).max() / np.abs(new).mean())
        charges = new.astype(float)
    return Atoms(positions, charges, ae.units.COULOMB), rings, np.flatnonzero(keep)


def fly(fields, places, lateral, end):
    """Ends of flights from rest, or with a lateral velocity, in units of nm and sqrt(n e V / m)."""
    count = len(places)
    velocities = lateral

    _, field = fields(places)
    start = np.sqrt(0.01 / np.linalg.norm(field, axis=1))  # time for some picometres
    state = np.concatenate([places.ravel(), velocities.ravel()])

    def change(logarithm, state):
        place, velocity = state.reshape(2, count, 3)
        moment = (start * math.exp(logarithm))[:, None]
        return np.concatenate([(velocity * moment).ravel(), (fields(place)[1] * moment).ravel()])

    # before the first moment the field is constant
    state[: 3 * count] += (velocities * start[:, None] + field * start[:, None] ** 2 / 2).ravel()
    state[3 * count :] += (field * start[:, None]).ravel()
    last = math.log(end / math.sqrt(2) / start.min())
    solved = scipy.integrate.solve_ivp(change, (0, last), state, method="DOP853", rtol=1e-6, atol=1e-7)
    place, velocity = solved.y[:, -1].reshape(2, count, 3)
    potential = fields(place)[0]
    return place, velocity, start * math.exp(last), potential, solved.nfev


def on_plane(ends, apex):
    """Distance from the axis over the flight length, azimuth, and time to the plane [nm] of flights."""
    place, velocity, moment, potential, _ = ends
    velocity = velocity * np.sqrt(1 + 2 * potential / (velocity**2).sum(axis=1))[:, None]
    rest = (LENGTH * ae.units.NM_PER_MM - place[:, 2] + apex) / velocity[:, 2]
    hit = place + velocity * rest[:, None]
    return hit[:, :2] / (LENGTH * ae.units.NM_PER_MM), moment + rest


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--radius", type=float, default=20.0, help="of the apex, in lattice constants")
    parser.add_argument("--ions", type=int, default=200)
    parser.add_argument("--events", type=int, default=4000, help="before the flights")
    parser.add_argument(
        "--cut", type=float, default=0.5, help="depth of the atoms below the centre of the cap, in radii"
    )
    parser.add_argument("--seed", type=int, default=1)
    options = parser.parse_args()
    report(*compare(**vars(options)))


def compare(radius, ions, events, cut=0.5, seed=1):
    """Directions and times by the rule and by the flights, and which ions had a lateral energy."""
    lens = ae.detection.LocalElectrode(distance=40e3, aperture=20e3, shank_angle=5.0)
    begin = time.process_time()
    emitter = surface(radius, lens.shank_angle, events, seed)
    cap = emitter.cap
    from_centre = emitter.positions - (0, 0, cap.apex - cap.radius)
    within = np.degrees(np.arccos(from_centre[:, 2] / np.linalg.norm(from_centre, axis=1))) < 32.0
    leaving = np.flatnonzero(within)[np.argsort(-emitter.fields[within])][:ions]
    rng = np.random.default_rng(seed)
    places, normals = emitter.positions[leaving], emitter.normals[leaving]
    across = np.cross(normals, rng.normal(size=places.shape))
    across /= np.linalg.norm(across, axis=1)[:, None]
    # every second ion has a lateral energy E / (e F R) of 3e-4
    kinetic = np.where(np.arange(len(leaving)) % 2, 3e-4, 0.0)
    print(
        f"R {cap.radius:.2f} nm, {len(emitter.positions):,} surface atoms; {time.process_time() - begin:.0f} s",
        flush=True,
    )

    free_atoms = Atoms(emitter.positions, emitter.charges, emitter.voltage)
    free_factor = emitter.voltage / (cap.field * cap.radius)
    lateral = across * np.sqrt(2 * kinetic / free_factor)[:, None]
    ends = fly(lambda at: free_atoms.field(at, leaving), places, lateral, 1e6)
    free_places, free_times = on_plane(ends, cap.apex)
    print(f"free flights: {ends[-1]} evaluations; {time.process_time() - begin:.0f} s", flush=True)

    atoms, rings, kept = in_instrument(emitter, lens, cap, cut)
    own = np.searchsorted(kept, leaving)
    scale = np.median(atoms.charges[own] / free_atoms.charges[leaving])  # of charges per volt
    spread = np.std(atoms.charges[own] / free_atoms.charges[leaving] / scale)
    behind = RunLens.of(lens, emitter.tip.settings, history_of(cap), emitter.tip.nearest_neighbour_distance)
    expected = free_factor * lens.field_factor(cap.radius) / behind.stages[0][4]
    print(f"charges per volt within {spread:.2%}: k_f {free_factor / scale:.3f}, by the lens {expected:.3f}")

    def both(at):
        one, two = atoms.field(at, own), rings.field(at)
        return one[0] + two[0], one[1] + two[1]

    lateral = across * np.sqrt(2 * kinetic / free_factor * scale)[:, None]
    ends = fly(both, places, lateral, 3e6)
    true_places, true_times = on_plane(ends, cap.apex)
    print(f"flights in the instrument: {ends[-1]} evaluations; {time.process_time() - begin:.0f} s", flush=True)

    volts = 1000.0 * np.ones(len(places))
    unit = ae.units.FLIGHT_TIME * np.sqrt(MASS / (CHARGE * volts))
    lengths = np.linalg.norm(free_places, axis=1)
    stereographic = free_places * (np.tan(np.arctan(lengths) / 2) / lengths)[:, None]
    numbers, masses, charges = np.zeros(len(places)), MASS * volts / volts, CHARGE * volts / volts
    seen, times = behind.seen(stereographic, free_times * unit, numbers, masses, charges, volts, volts / scale, LENGTH)
    return seen, times, true_places, true_times * unit * math.sqrt(scale), kinetic > 0


def history_of(cap):
    return RadiusHistory(np.array([0]), np.array([cap.radius]), np.array([cap.apex]))


def report(seen, times, true_places, true_times, moved):
    s = np.linalg.norm(seen, axis=1)
    found = seen * (np.tan(2 * np.arctan(s)) / s)[:, None]
    distance = np.linalg.norm(true_places, axis=1)
    off = np.linalg.norm(found - true_places, axis=1)
    outer = np.degrees(np.arctan(distance)) > 3
    for name, rows in (("at rest", ~moved), ("with a lateral energy", moved)):
        rows = rows & outer
        scale = float((found[rows] * true_places[rows]).sum() / (true_places[rows] ** 2).sum())
        shares, late = off[rows] / distance[rows], times[rows] / true_times[rows] - 1
        print(
            f"{name}: {rows.sum()} ions beyond 3 degrees; place off by {np.sqrt(np.mean(shares**2)):.3%} RMS, "
            f"{np.quantile(shares, 0.95):.3%} for 95 %, {shares.max():.3%} at most; mean scale {scale - 1:+.3%}; "
            f"times {late.mean():+.4%}, RMS {np.sqrt(np.mean(late**2)):.4%}, at most {np.abs(late).max():.4%}"
        )


if __name__ == "__main__":
    main()
