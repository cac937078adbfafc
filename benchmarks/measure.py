"""Speed and accuracy of apt_evap; prints tables and writes a JSON file. See `python benchmarks/measure.py --help`.

Speeds are given together with the accuracy. Where a reference exists, they are also given as a ratio to the reference,
measured in the same run.
"""

import argparse
import json
import platform
import resource
import time
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

import numpy as np

import apt_evap as ae
from apt_evap._core.flights import Flights
from apt_evap._core.interactions import InteractionLists, direct_field
from apt_evap._core.journal import Journal
from apt_evap._core.octree import Octree
from apt_evap._core.robin import Robin
from apt_evap.simulation.flight.response import ResponseModel

NICKEL = ae.material("Ni")
A = NICKEL.a


def nickel_tip(radius, shank, depth=8.0):
    """Ni[111] tip; radius and depth in lattice constants, shank in radii. Large tips are shells."""
    depth = depth * A if radius > 40 else None
    return ae.Tip(NICKEL, radius * A, axis=(1, 1, 1), shank_length=shank * radius * A, depth=depth)


def best(function, repeats=3):
    """Shortest time of several calls [s], and the last result."""
    times = []
    for _ in range(repeats):
        start = time.perf_counter()
        result = function()
        times.append(time.perf_counter() - start)
    return min(times), result


def peak_memory():
    """Peak memory of this process [GB]."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e6


def processor():
    """Name of the processor."""
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
        return next(line.split(":")[1].strip() for line in lines if line.startswith("model name"))
    except (OSError, StopIteration):
        return platform.processor()


# ---- (a) fields ------------------------------------------------------------------------------------------------------


def fields(radius=80, shank=3.0, targets=2000, angles=(0.5, 0.6, 0.7, 0.75, 0.8), threads=(1, 2)):
    """Field at all surface atoms from interaction lists; times relative to a direct float64 sum in the same run."""
    emitter = ae.evaporation.Emitter(nickel_tip(radius, shank, depth=5.0), n_threads=max(threads))
    positions, n = np.ascontiguousarray(emitter.positions), len(emitter)
    charges = np.random.default_rng(1).uniform(0.5, 1.5, n)
    tree = Octree(positions, charges)
    sample = np.random.default_rng(2).choice(n, targets, replace=False)
    points = np.ascontiguousarray(tree.positions[sample])
    seconds, exact = best(lambda: direct_field(points, tree.positions, tree.charges.copy()))
    direct = seconds * n / targets
    scale = np.sqrt((exact**2).sum(axis=1).mean())
    rows = []
    for angle in angles:
        for n_threads in threads:
            walk, lists = best(lambda angle=angle, n_threads=n_threads: InteractionLists(tree, angle, n_threads))
            field = np.empty((n, 3))
            sweep, _ = best(lambda lists=lists, field=field, n=n_threads: lists.sweep(field, False, n))
            error = np.linalg.norm(field[sample] - exact, axis=1) / scale
            rows.append(
                {
                    "opening angle": angle,
                    "threads": n_threads,
                    "lists [s]": walk,
                    "sweep [s]": sweep,
                    "direct / (lists + sweep)": direct / (walk + sweep),
                    "direct / sweep": direct / sweep,
                    "RMS error": float(np.sqrt((error**2).mean())),
                    "largest error": float(error.max()),
                    "Gpair/s": sum(lists.pairs) / sweep / 1e9,
                    "lists [MB]": lists.nbytes / 1e6,
                }
            )
    return {
        "title": f"field at all {n:,} surface atoms, Ni[111], R = {radius} a, shank {shank} R; direct float64 sum, "
        f"one thread: {n / direct * n / 1e9:.2f} Gpair/s, {direct:.1f} s (from {targets:,} targets)",
        "rows": rows,
    }


# ---- (b) solutions from scratch --------------------------------------------------------------------------------------


def solutions(radii=(20, 40, 80), shank=2.0, n_threads=2):
    """Number of sweeps and time from equal start charges, with and without mixing."""
    rows = []
    for radius in radii:
        emitter = ae.evaporation.Emitter(nickel_tip(radius, shank, depth=5.0), n_threads=n_threads)
        core = emitter._core
        lists = InteractionLists(core.tree, emitter.settings.opening_angle, n_threads)
        for window in (0, 8):
            for tolerance in (1e-3, 1e-6, 1e-10):
                core.tree.charges = np.ones(core.tree.n_slots)
                start = time.perf_counter()
                sweeps, residual = Robin(1e-5, window).iterate(
                    core.tree,
                    core.slot_normals,
                    lists,
                    tolerance=tolerance,
                    double_precision=tolerance < 1e-5,
                    n_threads=n_threads,
                )
                rows.append(
                    {
                        "R [a]": radius,
                        "surface atoms": len(emitter),
                        "mixed sweeps": window,
                        "tolerance": tolerance,
                        "sweeps": sweeps,
                        "residual": residual,
                        "seconds": time.perf_counter() - start,
                    }
                )
    return {"title": f"charges from scratch, {n_threads} threads", "rows": rows}


# ---- (c) (e) (f) ions ------------------------------------------------------------------------------------------------


def evaporate(emitter, events, clock=time.perf_counter):
    """Evaporate atoms without flights; return the times of events and of relaxations [s]."""
    relaxations = 0.0

    @contextmanager
    def timed():
        nonlocal relaxations
        start = clock()
        yield
        relaxations += clock() - start

    start = clock()
    for _ in emitter.advance(events, pause=timed):
        pass
    return clock() - start - relaxations, relaxations


def rates(radii=(20, 40, 80), shank=2.0, ions=10_000, threads=(1, 2), depth=8.0):
    """Time of an event, ions per second with one flight and with responses, peak memory."""
    rows = []
    for radius in radii:
        for n_threads in threads:
            start = time.perf_counter()
            simulation = ae.Simulation(nickel_tip(radius, shank, depth), seed=1, n_threads=n_threads)
            set_up = time.perf_counter() - start
            events, relaxations = evaporate(simulation.emitter, ions)
            speeds = []
            for responses in (False, True):
                start = time.perf_counter()
                simulation.run(ions, responses=responses, progress=False)
                speeds.append(ions / (time.perf_counter() - start))
            constant = ae.evaporation.Emitter(simulation.tip, rule=ae.ConstantPotential(), n_threads=n_threads)
            constant_potential = sum(evaporate(constant, ions))
            del constant
            rows.append(
                {
                    "R [a]": radius,
                    "surface atoms": len(simulation.emitter),
                    "threads": n_threads,
                    "start [s]": set_up,
                    "event [us]": events / ions * 1e6,
                    "relaxation, per event [us]": relaxations / ions * 1e6,
                    "ions/s, one flight": speeds[0],
                    "ions/s, responses": speeds[1],
                    "event and relaxation, constant potential [us]": constant_potential / ions * 1e6,
                    "peak memory [GB]": peak_memory(),
                }
            )
    return {"title": f"Ni[111], shank {shank} R, {ions:,} ions each", "rows": rows}


# ---- accuracy of events, flights and responses -----------------------------------------------------------------------


def charge_errors(radii=(40, 80), shank=1.0, sections=6):
    """Processor time of events and errors of charges, with relaxations of parts and of the whole surface; one thread.

    Emitters that differ in `whole_interval` evaporate one section each in turn. A section has ten relaxations.
    """
    rows = []
    for radius in radii:
        tip = nickel_tip(radius, shank)
        for rule, exact in ((ae.Robin(), 1e-7), (ae.ConstantPotential(), 1e-6)):
            emitters, times = {}, {10: [], 1: []}
            for whole_interval in times:
                settings = ae.evaporation.ChargeSettings(whole_interval=whole_interval)
                emitters[whole_interval] = ae.evaporation.Emitter(tip, rule=rule, settings=settings, n_threads=1)
            for _ in range(sections):
                for number, emitter in emitters.items():
                    times[number].append(evaporate(emitter, 10 * emitter.sweep_interval, time.process_time))
            for number, emitter in emitters.items():
                interval = emitter.sweep_interval
                per_event = np.array(times[number]) / (10 * interval) * 1e6
                row = {
                    "R [a]": radius,
                    "rule": type(rule).__name__,
                    "whole interval": number,
                    "events of a section": 10 * interval,
                    "event and relaxation [us]": float(np.median(per_event.sum(axis=1))),
                    "relaxation [us]": float(np.median(per_event[:, 1])),
                }
                # after five or six relaxations of parts; and before the second one after a converged solution
                evaporate(emitter, 5 * interval)
                row["RMS, after"], row["largest, after"] = charge_error(emitter, exact)
                evaporate(emitter, 2 * interval - 1 - emitter._core.since_relaxation)
                row["RMS, before"], row["largest, before"] = charge_error(emitter, exact)
                rows.append(row)
    return {"title": f"events without flights, Ni[111], shank {shank} R, medians of {sections} sections", "rows": rows}


def charge_error(emitter, tolerance):
    """RMS and largest error of the charges relative to their mean, against the converged solution."""
    atoms, charges = emitter.atoms, emitter.charges.copy()
    emitter.relax(tolerance)
    solution = np.zeros(len(emitter.tip))
    solution[emitter.atoms] = emitter.charges
    solution = solution[atoms]
    error = (charges * (solution.sum() / charges.sum()) - solution) / solution.mean()
    return float(np.sqrt((error**2).mean())), float(np.abs(error).max())


def potentials(radii=(5, 7, 10, 14, 20), events=1000, step=25, n_threads=1):
    """Potential in the centre, and charges of the cap, against converged copies of the surface; with and without bound.

    Measured every `step` events and before each relaxation. The cap is the part within 60 degrees of the axis.
    """
    rows = []
    for radius in radii:
        tip = ae.Tip(NICKEL, radius * A, axis=(1, 1, 1))
        for rule, bound in ((ae.Robin(), 1.0), (ae.Robin(), 4e-3), (ae.ConstantPotential(), 4e-3)):
            settings = ae.evaporation.ChargeSettings(potential_bound=bound)
            emitter = ae.evaporation.Emitter(tip, rule=rule, settings=settings, n_threads=n_threads)
            exact = ae.evaporation.Emitter(tip, rule=rule, n_threads=n_threads)
            removed, n, errors = [], 0, []
            for batch in emitter.advance(events, batch_size=step):
                removed.append(batch.site)
                n += len(batch)
                exact.remove(np.concatenate(removed))
                exact.relax(1e-7)
                removed = []
                order, reference = np.argsort(emitter.atoms), np.argsort(exact.atoms)
                x, y, z = exact.positions[reference].T
                cap = np.hypot(x, y) < np.tan(np.radians(60)) * z
                charges, known = emitter.charges[order][cap], exact.charges[reference][cap]
                inside, expected = (each.potential_at([tip.potential_point], 0.0)[0] for each in (emitter, exact))
                errors.append((np.sqrt(np.mean((charges - known) ** 2)) / known.mean(), inside / expected - 1))
            cap, inside = np.array(errors).T
            rows.append(
                {
                    "R [a]": radius,
                    "surface atoms": len(emitter),
                    "rule": type(rule).__name__,
                    "bound": bound,
                    "events": n,
                    "cap, RMS [%]": 100 * float(np.sqrt(np.mean(cap**2))),
                    "cap, largest RMS [%]": 100 * float(cap.max()),
                    "potential, lowest [%]": 100 * float(inside.min()),
                    "potential, highest [%]": 100 * float(inside.max()),
                }
            )
    return {"title": f"between relaxations, Ni[111], shank 2 R, {events:,} events", "rows": rows}


def flights(radii=(20, 40, 80, 120), shank=2.0, ions=256, group=17):
    """Time and evaluations of a flight, alone and in a group with common walks through the octree; one thread."""
    rows = []
    for radius in radii:
        emitter = ae.evaporation.Emitter(nickel_tip(radius, shank))
        batch = emitter.evaporate(min(ions, emitter.sweep_interval))
        tip, settings = emitter.tip, ae.simulation.FlightSettings()
        speed = np.sqrt(2 * 0.5)  # 0.5 eV, charge state 1
        for launches in (1, group):
            flier = flier_over(batch.tree, tip, settings)
            angle = np.tile(2 * np.pi * np.arange(launches) / launches, len(batch))
            first, second = (np.repeat(t, launches, axis=0) for t in ae.emission.tangent_frame(batch.normals))
            velocities = speed * (np.cos(angle)[:, None] * first + np.sin(angle)[:, None] * second)
            positions = np.repeat(tip.positions[batch.site], launches, axis=0)
            start = time.perf_counter()
            fly(flier, batch.journal, np.arange(len(batch)), launches, positions, velocities)
            seconds = time.perf_counter() - start
            n_flights = len(batch) * launches
            rows.append(
                {
                    "R [a]": radius,
                    "launches per group": launches,
                    "time per flight [us]": seconds / n_flights * 1e6,
                    "steps": flier.n_steps / len(batch),
                    "evaluations per flight": flier.n_evaluations / n_flights,
                    "atoms and cells per evaluation": flier.n_pairs / flier.n_evaluations,
                }
            )
    return {"title": "flights, one thread, including the replay of the events", "rows": rows}


def flier_over(tree, tip, settings):
    """Flights in the field of a tree, with the settings of `Simulation`."""
    return Flights(
        tree,
        coulomb=ae.units.COULOMB,
        length=tip.nearest_neighbour_distance,
        centre=(0.0, 0.0, tip.apex),
        reach=settings.reach * tip.nearest_neighbour_distance,
        opening_angle=settings.opening_angle,
        tolerance=settings.tolerance,
        max_steps=settings.max_steps,
    )


def fly(flier, journal, events, launches, positions, velocities):
    """Fly groups of launches; return ends (m, 7) and outcomes (m,)."""
    end, outcome = np.empty((len(positions), 7)), np.empty(len(positions), np.int8)
    start = np.arange(0, len(positions) + 1, launches)
    counter, halt = np.zeros((2, 1), np.int64)
    flier.fly(journal, np.asarray(events), start, positions, velocities, end, outcome, counter, halt)
    return end, outcome


def flight_errors(radii=(40, 80), shank=1.0, ions=300):
    """Places of flights alone against those with sums over all atoms and steps with an error of 1e-9, in one field.

    Ions start from atoms within 45 degrees of the axis, of the tenth with the highest fields; half of them at rest, the
    others with up to 1 eV along the surface. DOP853 gives the places of the reference (simulation/test_flights).
    """
    rows = []
    for radius in radii:
        emitter = ae.evaporation.Emitter(nickel_tip(radius, shank), n_threads=1)
        evaporate(emitter, int(1.5 * emitter.sweep_interval))
        positions, normals, fields, tip = emitter.positions, emitter.normals, emitter.fields, emitter.tip
        tree = Octree(np.ascontiguousarray(positions), emitter.charges.copy())
        random = np.random.default_rng(0)
        cap = positions[:, 2] > np.hypot(positions[:, 0], positions[:, 1])
        chosen = random.choice(np.flatnonzero(cap & (fields > np.quantile(fields[cap], 0.9))), ions, replace=False)
        first, second = ae.emission.tangent_frame(normals[chosen])
        angle, energy = random.uniform(0, 2 * np.pi, (ions, 1)), random.uniform(0, 1.0, (ions, 1))
        energy[: ions // 2] = 0.0
        velocities = np.sqrt(2 * energy) * (np.cos(angle) * first + np.sin(angle) * second)
        starts = np.ascontiguousarray(positions[chosen] + 0.12 * normals[chosen])
        settings = ae.simulation.FlightSettings()
        places = []
        for accuracy in (replace(settings, opening_angle=0.0, tolerance=1e-9), settings):
            flier = flier_over(tree, tip, accuracy)
            start = time.process_time()
            end, _ = fly(flier, Journal(tip.positions, 1), np.full(ions, -1), 1, starts, velocities)
            seconds = time.process_time() - start
            ahead = (tip.apex + 1e8 - end[:, 2]) / end[:, 5]  # a detector at 100 mm
            places.append(end[:, :2] + ahead[:, None] * end[:, 3:5])
        errors = np.linalg.norm(places[1] - places[0], axis=1) / 1e3
        rows.append(
            {
                "R [a]": radius,
                "flights": ions,
                "time per flight [us]": seconds / ions * 1e6,
                "steps": flier.n_steps / ions,
                "median [um]": float(np.median(errors)),
                "95 % [um]": float(np.quantile(errors, 0.95)),
                "largest [um]": float(errors.max()),
            }
        )
    return {"title": "flights alone, detector at 100 mm", "rows": rows}


def bundle_errors(radii=(40, 80), shank=1.0, events=5000, ions=240, checked=120, repeats=5):
    """Flights of the launches of responses, all of an ion together, and of one launch an ion; one thread.

    Places of five launches of some ions are compared with those of sums over all atoms and steps with an error of 1e-6.
    Two versions are compared by calls in turn with their folders in PYTHONPATH: events have the same bits.
    The settings of the flights were chosen with the ions after other numbers of events.
    """
    rows, columns = [], np.array([0, 40, 62, 100, 139])
    for radius in radii:
        simulation = ae.Simulation(nickel_tip(radius, shank), seed=1, n_threads=1)
        emitter, tip, n = simulation.emitter, simulation.tip, 0
        evaporate(emitter, events)
        model = ResponseModel(simulation.response_settings, simulation.detector)
        settings = ae.simulation.FlightSettings()
        seconds, errors, counts = np.zeros((2, repeats)), ([], []), np.zeros(2)
        emitter.request_tree_copy()
        for batch in emitter.advance(ions):
            emitter.request_tree_copy()  # each batch has its own
            if not len(batch):
                continue
            emissions = simulation._emissions(batch, np.arange(n, n + len(batch)))
            positions, velocities = model.launches(emissions)
            flown = np.flatnonzero(np.isfinite(positions).all(axis=(1, 2)))
            some = flown[:: max(1, ions // checked)]
            ends = []
            for accuracy, numbers, launches, counted in (
                (replace(settings, opening_angle=0.0, tolerance=1e-6), np.repeat(some, len(columns)), None, None),
                (settings, flown, np.arange(positions.shape[1]), 0),
                (settings, flown, columns[:1], 1),
            ):
                if launches is None:
                    groups = positions[some][:, columns], velocities[some][:, columns]
                else:
                    groups = positions[flown][:, launches], velocities[flown][:, launches]
                starts, pushes = (np.ascontiguousarray(group.reshape(-1, 3)) for group in groups)
                for repeat in range(repeats if counted is not None else 1):
                    flier = flier_over(batch.tree, tip, accuracy)
                    start = time.process_time()
                    end, _ = fly(flier, batch.journal, numbers, len(starts) // len(numbers), starts, pushes)
                    if counted is not None:
                        seconds[counted, repeat] += time.process_time() - start
                if counted == 0:
                    counts += flier.n_steps, flier.n_pairs
                ahead = (tip.apex + 1e8 - end[:, 2]) / end[:, 5]  # a detector at 100 mm
                places = (end[:, :2] + ahead[:, None] * end[:, 3:5]) / 1e3
                ends.append(places.reshape(*groups[0].shape[:2], 2))
            rows_of_some = np.searchsorted(flown, some)
            errors[0].append(np.linalg.norm(ends[1][rows_of_some][:, columns] - ends[0], axis=-1).ravel())
            errors[1].append(np.linalg.norm(ends[2][rows_of_some][:, 0] - ends[0][:, 0], axis=-1))
            n += len(batch)
        for number, name in enumerate((f"{positions.shape[1]} together", "alone")):
            found = np.concatenate(errors[number])
            rows.append(
                {
                    "R [a]": radius,
                    "launches": name,
                    "ions": n,
                    "median time of an ion [us]": float(np.median(seconds[number])) / n * 1e6,
                    "shortest [us]": float(seconds[number].min()) / n * 1e6,
                    "steps": counts[0] / n if number == 0 else float("nan"),
                    "pairs [1000]": counts[1] / n / 1e3 if number == 0 else float("nan"),
                    "checked": len(found),
                    "median [um]": float(np.median(found)),
                    "95 % [um]": float(np.quantile(found, 0.95)),
                    "largest [um]": float(found.max()),
                }
            )
    return {"title": "launches of responses, detector at 100 mm, replay of the events included", "rows": rows}


def place_errors(radius=40, shank=1.0, events=5000, ions=200, n_threads=2):
    """Hit positions of a run against exact flights in the exact field: converged charges, sums over all atoms."""
    simulation = ae.Simulation(nickel_tip(radius, shank), seed=1, n_threads=n_threads)
    detector, tip, errors = simulation.detector, simulation.tip, []
    for _ in range(ions):
        evaporate(simulation.emitter, events // ions - 1)
        run = simulation.run(1, responses=False, progress=False)
        emitter = simulation.emitter
        tree = Octree(np.ascontiguousarray(emitter.positions), emitter.charges.copy())
        normals = np.ascontiguousarray(emitter.normals[tree.atoms])
        Robin(1e-5, 8).iterate(
            tree,
            normals,
            InteractionLists(tree, 0.3, n_threads),
            tolerance=1e-6,
            double_precision=True,
            n_threads=n_threads,
        )
        potential = ae.units.COULOMB * tree.potentials(tip.potential_point[None], 0.0)[0]
        tree.charges = tree.charges * (simulation.voltage / potential)
        flier = flier_over(tree, tip, ae.simulation.FlightSettings(opening_angle=0.0, tolerance=1e-6))
        end, _ = fly(flier, Journal(tip.positions, 1), [-1], 1, run.emissions.positions, np.zeros((1, 3)))
        x, y, *_ = detector.impacts(*detector.directions(end[:, :3], end[:, 3:6], tip.apex))
        hits = run.hits(ae.Unperturbed())
        errors.append(np.hypot(hits.x - x, hits.y - y)[0])
    rows = [
        {
            "ions": ions,
            "events": events,
            "median [mm]": float(np.median(errors)),
            "99 % [mm]": float(np.quantile(errors, 0.99)),
            "largest [mm]": float(np.max(errors)),
        }
    ]
    return {"title": f"hit positions against exact flights in the exact field, Ni[111], R = {radius} a", "rows": rows}


def response_errors(radii=(20, 80), shank=2.0, events=5000, ions=200, n_threads=2):
    """Hit positions from responses against flights, for energies up to 1.5 eV that are not in the design."""
    rows = []
    energies = [0.05, 0.2, 0.5, 0.8, 1.1, 1.5]
    for radius in radii:
        simulation = ae.Simulation(nickel_tip(radius, shank), seed=1, n_threads=n_threads)
        evaporate(simulation.emitter, events)
        checks = [kind(energy) for energy in energies for kind in (ae.LateralVelocity, ae.RollUp)]
        run = simulation.run(ions, emissions=checks, progress=False)
        for kind in (ae.LateralVelocity, ae.RollUp):
            errors = []
            for energy in energies:
                direct, fit = run.hits(kind(energy)), run.hits(kind(energy), by_response=True)
                both = direct.detected & fit.detected
                errors.append(np.hypot(direct.x - fit.x, direct.y - fit.y)[both])
            errors = np.concatenate(errors)
            rows.append(
                {
                    "R [a]": radius,
                    "launches": kind.__name__,
                    "flights": len(errors),
                    "median [mm]": float(np.median(errors)),
                    "95 % [mm]": float(np.quantile(errors, 0.95)),
                    "largest [mm]": float(errors.max()),
                    "flagged ions [%]": 100 * float(run.flagged.mean()),
                }
            )
    return {"title": f"responses against flights, energies up to 1.5 eV, {ions} ions", "rows": rows}


def hits_of_a_million(ions=1_000_000, n_threads=2):
    """Time of `Run.hits` for a million ions, from copies of a small run."""
    run = ae.Simulation(nickel_tip(12, 1.0), seed=1, n_threads=n_threads).run(2000, progress=False)
    numbers, n = run.emissions.ions, len(run)
    copies = [replace(run, emissions=replace(run.emissions, ions=numbers + k * n)) for k in range(ions // n)]
    run = ae.Run.join(copies)
    energy = ae.TruncatedNormal(0.155, 0.155)
    rows = []
    for perturbation in (ae.Unperturbed(), ae.LateralVelocity(energy), ae.RollUp(energy), ae.Combined(energy, 0.75)):
        seconds, hits = best(lambda perturbation=perturbation: run.hits(perturbation))
        rows.append({"perturbation": type(perturbation).__name__, "ions": len(hits), "seconds": seconds})
    return {"title": "Run.hits from responses", "rows": rows}


# ---- the base --------------------------------------------------------------------------------------------------------


def bases(radius=20, shanks=(0.5, 1.0, 2.0, 3.0, 5.0, 8.0), ions=200, n_threads=2):
    """Influence of the foot on fields and hit positions of the cap, relative to the longest shank."""
    cases = [(base, shank) for shank in shanks for base in ("rounded", "flat")]
    results = {}
    for base, shank in cases:
        tip = ae.Tip(NICKEL, radius * A, axis=(1, 1, 1), shank_length=shank * radius * A, base=base)
        simulation = ae.Simulation(tip, seed=1, n_threads=n_threads)
        emitter = simulation.emitter
        emitter.relax(1e-8)
        cap = emitter.positions[:, 2] > 0.5 * radius * A
        # atoms of all caps in the same order, up to rounding
        order = np.lexsort(np.round(emitter.positions[cap], 6).T)
        fields = emitter.fields[cap][order]
        sites = (emitter.positions + 0.25 * emitter.normals)[cap][order]
        rim = emitter.fields[emitter.positions[:, 2] < -0.5 * shank * radius * A].max()
        # the same launches for all specimens: one flight from each site, before the first event
        batch = emitter.evaporate(1)
        starts = np.ascontiguousarray(sites[:: max(1, len(sites) // ions)])
        flier = flier_over(batch.tree, tip, ae.simulation.FlightSettings())
        end, _ = fly(flier, batch.journal, np.full(len(starts), -1), 1, starts, np.zeros_like(starts))
        directions, remaining = simulation.detector.directions(end[:, :3], end[:, 3:6], tip.apex)
        results[base, shank] = fields, rim, np.stack(simulation.detector.impacts(directions, remaining)[:2], axis=1)
    reference = results["rounded", shanks[-1]]
    rows = []
    for (base, shank), (fields, rim, hits) in results.items():
        relative = fields / fields.mean() / (reference[0] / reference[0].mean()) - 1
        radial = np.hypot(*hits.T) / np.hypot(*reference[2].T)
        rows.append(
            {
                "base": base,
                "shank [R]": shank,
                "V/(R mean cap field)": 1000.0 / (radius * A * fields.mean()),
                "cap field / mean, RMS change": float(np.sqrt((relative**2).mean())),
                "largest change": float(np.abs(relative).max()),
                "magnification": float(np.nanmedian(radial)),
                "standard deviation": float(np.nanstd(radial)),
                "largest field of the foot / of the cap": rim / fields.max(),
            }
        )
    return {
        "title": f"influence of the foot, Ni[111], R = {radius} a; relative to a rounded base at {shanks[-1]:g} R",
        "rows": rows,
    }


# ---- printing --------------------------------------------------------------------------------------------------------

PARTS = {
    "fields": fields,
    "solutions": solutions,
    "rates": rates,
    "flights": flights,
    "alone": flight_errors,
    "bundles": bundle_errors,
    "charges": charge_errors,
    "potentials": potentials,
    "places": place_errors,
    "responses": response_errors,
    "hits": hits_of_a_million,
    "bases": bases,
    "large": lambda: rates(radii=(284,), ions=20_000, threads=(2,), depth=7.0),
}


def table(result):
    """Text of one table."""
    rows = [[_text(value) for value in row.values()] for row in result["rows"]]
    heads = list(result["rows"][0])
    widths = [max(map(len, column)) for column in zip(heads, *rows, strict=True)]
    lines = ["  ".join(cell.rjust(width) for cell, width in zip(row, widths, strict=True)) for row in [heads, *rows]]
    return "\n".join([result["title"], *lines, ""])


def _text(value):
    return f"{value:.4g}" if isinstance(value, float) else f"{value:,}" if isinstance(value, int) else str(value)


def main():
    """Run the given benchmarks, or all except the largest one."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("parts", nargs="*", help=f"{', '.join(PARTS)}; default: all except large")
    parser.add_argument("-o", "--output", default="measure.json", help="JSON file (default: %(default)s)")
    arguments = parser.parse_args()
    for name in arguments.parts:
        if name not in PARTS:
            parser.error(f"unknown benchmark {name!r}, must be one of {', '.join(PARTS)}")
    results = {"processor": processor(), "version": ae.__version__, "python": platform.python_version()}
    print(f"{results['processor']}, apt_evap {ae.__version__}\n")
    for name in arguments.parts or [name for name in PARTS if name != "large"]:
        results[name] = PARTS[name]()
        print(table(results[name]), flush=True)
        Path(arguments.output).write_text(json.dumps(results, indent=1, default=float))


if __name__ == "__main__":
    main()
