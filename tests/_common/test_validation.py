"""The door: every public argument, given something bad, is refused in one sentence with its name and the value."""

import inspect
import json
import math
import os
import re
import subprocess
import sys
import warnings
from dataclasses import fields, is_dataclass
from functools import partial
from pathlib import Path

import numpy as np
import pytest

import apt_evap as ae
from apt_evap._common import memory
from apt_evap._common.codec import declared
from apt_evap._common.validation import short_text
from apt_evap.config.cost_estimate import CostEstimate
from apt_evap.config.simulation_file import read_config
from apt_evap.emission.perturbations import perturbation_of
from apt_evap.emission.surface_frame import target_shares
from apt_evap.simulation.real_units import RealUnits
from apt_evap.specimen.materials import polarization_energy
from apt_evap.specimen.shape import TaperedCap

NAN, INF = math.nan, math.inf
NEITHER = [None, "x", "5", True, 1j, [1.0], {}, b"x", object(), np.array([1.0, 2.0])]  # no number
WILD = [NAN, INF, -INF, 1e300, 10**400, 10**5000]  # no number to compute with
NUMBER = [*NEITHER, *WILD]
POSITIVE = [*NUMBER, 0, -1.5]
COUNT = [*NEITHER, *WILD, 1.5, -1, 2**80, np.float64(2.0)]
SEED = [*COUNT, 2**64]
SWITCH = [None, "no", 0, 1.0, [], np.array([True])]
OBJECT = [True, "x", 0, NAN, [], {}, np.array([1.0, 2.0]), object(), dict]
TABLE = [True, "x", 3, NAN, [1], np.array([1.0]), object()]
VECTOR = [
    None,
    "x",
    ("1", "2", "3"),
    1j,
    5,
    [],
    [1.0, NAN, 0],
    [1.0, INF, 0],
    [10**400, 0, 0],
    [[1.0], [2.0]],
    object(),
]
TEXT = [None, True, 3, NAN, [], b"x", np.array([1.0])]
COLUMN = ["x", 3, 1j, [[1.0], [2.0]], ["a", "b"], object()]
WHOLE = ["x", 3, [0.5, 1], [NAN, 1], [2**70, 1]]
WORD = [*TEXT, "", "no such"]

nickel = ae.material("Ni")
MATERIAL = {"name": "X", "structure": "fcc", "a": 0.35, "evaporation_field": 35.0, "charge_state": 1, "mass": 58.0}
TIP = {"material": nickel, "apex_radius": 1.5, "depth": 1.2}
ATOMS = {"positions": np.indices((5, 5, 5)).reshape(3, -1).T * 0.3, "species": np.zeros(125, int), "elements": ["Ni"]}
HITS = {"x": [1.0, 2.0], "y": [1.0, 2.0], "ion": [0, 1]}
RANGES = {"names": ["Ni"], "low": [50.0], "high": [60.0]}
EMISSIONS = {
    "positions": np.zeros((1, 3)),
    "normals": [[0.0, 0.0, 1.0]],
    "neighbours": np.ones((1, 3)),
    "charge_states": [1],
    "masses": [58.0],
    "ions": [0],
    "nearest_neighbour_distance": 0.25,
}
hits = ae.Hits(x=[1.0, 2, 3], y=[1.0, 2, 4], mass_to_charge=[58.0, 59.0, 59.0], voltage=[1e3, 1e3, 1e3])
grid = ae.DetectorMap.from_array(np.ones((20, 20)), np.arange(21), np.arange(21))
ranges = ae.detection.Ranges(**RANGES)
ring = ae.maps.radial_profile(hits, outer=9.0)
strip = ae.maps.Rectangle((0.0, 0.0), 0.0, 20.0, 20.0)
azimuths = ae.maps.ring_statistics(
    grid, ae.detection.Projection(10.0, centre=(10.0, 10.0)), rings=[(5.0, 40.0)], sectors=4
)[0]
CORNERS = [(0.0, 0.0), (1.0, 0.0), (0.0, 1.0)]
shell = ae.Tip(**TIP)


@pytest.fixture(scope="module")
def ready():
    """A simulation, its run, and the ions on file."""
    simulation = ae.Simulation(shell, n_threads=1)
    run = simulation.run(12, progress=False)
    bound = {"fit_energies": partial(ae.fit_energies, run), "lateral_tracks": partial(ae.analysis.lateral_tracks, run)}
    return {
        "simulation": simulation,
        "run": run,
        "real": run.at_evaporation_field(field_reference="site"),
        "emitter": simulation.emitter,
        "tracks": bound["lateral_tracks"],
        "fit_energies": bound["fit_energies"],
    }


# what is called, its good arguments, and the bad values of each argument
CASES = [
    (
        ae.Material,
        MATERIAL,
        {
            "name": [*TEXT, ""],
            # Angstrom
            # V/m
            # not of fcc
            "sources": [*TABLE, None],
        },
    ),
    (ae.material, {"name": "Ni"}, {"name": [*WORD, "ni", "Co"], "a": POSITIVE, "structure": WORD}),
    (
        ae.Tip,
        TIP,
        {
            "material": [*OBJECT, None, "Unobtainium"],
            "apex_radius": [*POSITIVE, 0.5, 1e9],
            "axis": [*VECTOR, (0, 0, 0), (1, 1)],
            "shank_angle": [*NUMBER, -1.0, 45, 90.0],
            "shank_length": [value for value in POSITIVE if value is not None] + [1e9],
            "base": WORD,
            "rotation": NUMBER,
            "origin": VECTOR,
            "offset_seed": [value for value in SEED if value is not None],
            "depth": [value for value in POSITIVE if value is not None] + [0.1],
            "solutes": [*TABLE, {"Cu": 2.0}, {"Cu": "half"}, {3: 0.1}],
        },
    ),
    (ae.Tip, TIP | {"solutes": {"Cu": 0.1}}, {"seed": SEED}),
    (
        ae.Tip.from_positions,
        ATOMS,
        {
            "positions": [*VECTOR, np.zeros((3, 2)), [[0, 0, NAN]], np.zeros((1, 3))],
            "species": [None, "x", 3, [0.5] * 125, [0] * 124, [-1] * 125, [1] * 125, [2**40] * 125, [NAN] * 125],
            "elements": [None, "Ni", 3, [], [3], NAN, object()],
            "evaporable": [3, "x", [True], np.ones(125, int), object()],
            "neighbour_radius": [value for value in POSITIVE if value is not None] + [1e4],
            "surface_threshold": [value for value in POSITIVE if value is not None] + [1e4],
            "potential_point": [value for value in VECTOR if value is not None],
        },
    ),
    (
        ae.specimen.Phase,
        {"name": "matrix", "material": nickel},
        {
            "name": [*TEXT, ""],
            "material": [*OBJECT, None, "Unobtainium"],
            "region": [True, "x", 3, NAN, [], {}, np.array([1.0]), object(), dict],
            "axis": [value for value in VECTOR if value is not None] + [(0, 0, 0)],
            "order": [*OBJECT, "L1_2"],
            "solutes": [*TABLE, {"Cu": 2.0}, {"Cu": "half"}, {3: 0.1}],
            "evaporation_field": ["x", True, [1.0], *WILD, 0, -1.0, 35e9, {"Al": 3.0}, {"Ni": "x"}],
        },
    ),
    (
        ae.Tip,
        {"phases": [ae.specimen.Phase("m", nickel)], "apex_radius": 1.5},
        {"phases": [*TABLE, None, [3], [], [nickel]]},
    ),
    (ae.specimen.Segregation, {"bulk": 0.1, "peak": 0.2, "width": 1.0}, {}),
    (
        ae.specimen.Segregation,
        {"bulk": 0.1, "peak": 0.2, "width": 1.0},
        {"region": [True, "x", 3, [], {}, dict, len]},
    ),
    (
        ae.specimen.Superlattice,
        {"prototype": "B2", "second": "Al"},
        {"second": [None, True, 3, [], {}, "Unobtainium", {"Al": 0.5}]},
    ),
    (
        ae.specimen.UnitCell,
        {"sites": ("Al",)},
        {"sites": [None, 3, "x", [], [3], {"Al": 1}], "cells": [None, 3, "x", (1, 1), (0, 1, 1), (2, 2, 2)]},
    ),
    (
        ae.specimen.Sphere,
        {"centre": (0, 0, 0), "radius": 1.0},
        {
            "centre": VECTOR,
        },
    ),
    (
        ae.specimen.Ellipsoid,
        {"centre": (0, 0, 0), "semi_axes": (1, 2, 3)},
        {"centre": VECTOR, "semi_axes": [*VECTOR, (1, 1, 0)], "axis": [*VECTOR, (0, 0, 0)]},
    ),
    (
        ae.specimen.Cylinder,
        {"centre": (0, 0, 0), "radius": 1.0},
        {
            "centre": VECTOR,
            "axis": [*VECTOR, (0, 0, 0)],
        },
    ),
    (
        ae.specimen.Layer,
        {"lower": 0.0, "upper": 1.0},
        {"normal": [*VECTOR, (0, 0, 0)]},
    ),
    (
        ae.specimen.HalfSpace,
        {"point": (0, 0, 0), "normal": (1, 0, 0)},
        {"point": VECTOR, "normal": [*VECTOR, (0, 0, 0)]},
    ),
    (
        ae.specimen.CoreShell,
        {"core": ae.specimen.Sphere((0, 0, 0), 1), "thickness": 1.0},
        {
            "core": [*OBJECT, None],
        },
    ),
    (ae.Tip.from_settings, {"settings": shell.settings}, {"settings": [*TABLE, None, {}, {"apex_radius": 3}]}),
    (shell.signed_distance, {"points": np.zeros((1, 3))}, {"points": VECTOR}),
    (shell.deepened, {}, {"by": [value for value in POSITIVE if value is not None]}),
    (TaperedCap, {"apex_radius": 3.0, "shank_length": 3.0}, {"apex_radius": POSITIVE, "shank_length": POSITIVE}),
    (
        ae.Arrhenius,
        {"temperature": 50.0},
        {
            "sensitivity": [*(value for value in POSITIVE if not isinstance(value, dict)), {"Ni": -1.0}],
            "laser": [*OBJECT, dict],
            "bonds": [*OBJECT, ae.evaporation.PairEnergies],
        },
    ),
    (
        ae.evaporation.Laser,
        {"temperature_rise": 100.0},
        {
            "direction": [*VECTOR[:3], (0.0, 0.0), (1.0,)],
        },
    ),
    (
        ae.evaporation.CoordinationTable,
        {},
        {"table": [*TABLE, None, {}, {"W": {}}, {"W": 3}, {"W": {4: -1.0}}, {"W": {99: 50.0}}, {"W": {4.5: 50.0}}]},
    ),
    (
        ae.evaporation.PairEnergies,
        {},
        {
            "cohesive_energies": [*TABLE, {"Ni": -1.0}, {"Ni": "x"}],
            "ionisation_works": [*TABLE, {"Ni": 0.0}],
            "ordering": [*TABLE, {"Al": 0.1}, {"Al-Cu": 99.0}, {3: 0.1}],
        },
    ),
    (
        ae.maps.ring_statistics,
        {"map": grid, "projection": ae.detection.Projection(10.0, centre=(10.0, 10.0))},
        {
            "map": [*OBJECT, None],
            "projection": [*OBJECT, None],
            "pole": [*VECTOR, (0, 0, 0)],
            "rings": [3, [(1.0,)], [(5.0, 2.0)], [(0.0, 99.0)], [(NAN, 3.0)]],
            "fold": [*COUNT, 0, 7],
            "sectors": [*COUNT, 0, 1, 10**6],
        },
    ),
    (
        ae.maps.folded,
        {
            "map": grid,
            "projection": ae.detection.Projection(30.0, centre=(10.0, 10.0)),
            "pole": (0.0, 0.0, 1.0),
            "symmetry": "2mm",
            "toward": (1.0, 0.0, 0.0),
        },
        {
            "map": [*OBJECT, None],
            "projection": [*OBJECT, None],
            "pole": [*VECTOR, (0, 0, 0)],
            "symmetry": WORD,
            "toward": [*VECTOR, (0, 0, 0), (0.0, 0.0, 2.0)],
            "reach": [*POSITIVE, 91.0, 1e-9],
            "smoothing": [*POSITIVE, 0.1, 1e9],
            "seed": [value for value in SEED if value is not None],
        },
    ),
    (
        ae.maps.trace_line,
        {"map": grid, "ends": (5.0, 5.0, 15.0, 15.0), "width": 5.0},
        {
            "map": [*OBJECT, None],
            "ends": [None, "x", 3, (0.0, 0.0), (1.0, 1.0, 1.0, 1.0), (NAN, 0.0, 1.0, 1.0)],
            "width": POSITIVE,
        },
    ),
    (
        ae.maps.line_amplitude,
        {"ring": azimuths, "measured": azimuths},
        {"ring": [*OBJECT, None], "measured": [*OBJECT, None], "shift": COUNT, "mirror": SWITCH},
    ),
    (ae.analysis.charge_state_ratio_map, {"element": "Ni"}, {"hits": [*OBJECT, None]}),
    (ae.analysis.charge_state_ratio_history, {"element": "Ni"}, {"hits": [*OBJECT, None]}),
    (
        ae.Instrument,
        {},
        {
            "projection": WORD,
            **{name: [*NUMBER, -0.1] for name in ("dead_time", "dead_zone", "resolution")},
            "quantisation": [value for value in VECTOR if value is not None] + [(0.0, 1.0), (1.0, -1.0)],
            "timing": [*OBJECT, dict],
        },
    ),
    (ae.Instrument.preset, {"name": "straight, 100 mm"}, {"name": WORD, "efficiency": [*POSITIVE, 1.1]}),
    (ae.Instrument().record, {}, {"hits": [*OBJECT, None]}),
    (
        ae.Instrument().hits,
        {"hits": ae.Hits(**HITS, time_of_flight=[1.0, 2.0], pulse_id=[0, 1])},
        {"hits": [*OBJECT, None], "distance": [value for value in POSITIVE if value is not None], "seed": SEED},
    ),
    (ae.Extremal, {}, {"bonds": [*OBJECT, ae.evaporation.PairEnergies]}),
    (
        ae.reconstruction.interface_profile,
        {"distances": np.linspace(-0.9, 0.9, 60), "chosen": np.arange(60) % 3 == 0},
        {"distances": ["x", 3, [NAN, 1.0, 2.0, 3.0]], "reach": POSITIVE, "bin_width": POSITIVE},
    ),
    (
        ae.reconstruction.segregation_profile,
        {"distances": np.linspace(-0.9, 0.9, 60), "chosen": np.arange(60) % 3 == 0},
        {"distances": ["x", 3, [NAN, 1.0, 2.0, 3.0]], "reach": POSITIVE, "bin_width": POSITIVE},
    ),
    (
        ae.ResponseSettings,
        {},
        {"site": [*OBJECT, None], "rolled": [*OBJECT, None]},
    ),
    (
        ae.simulation.Design,
        {"degree": 1, "rings": ((0.0, 1), (1.0, 5))},
        {
            "rings": [None, 3, "x", [], [1], [(1.0,)], [(NAN, 5)], [(1.0, 0)], [(1.0, 10**9)], [(1.0, 2)], [("a", 1)]],
        },
    ),
    (ae.TruncatedNormal, {"mean": 0.1, "standard_deviation": 0.1}, {}),
    (ae.LateralVelocity, {"energy": 0.1}, {"energy": [*NUMBER, -0.1, 155]}),
    (ae.RollUp, {"energy": 0.1}, {"energy": [*NUMBER, -0.1, 155]}),
    (
        ae.Combined,
        {"energy": 0.1, "rollup_fraction": 0.5},
        {
            "energy": NUMBER,
        },
    ),
    (perturbation_of, {}, {"perturbation": [*TABLE, None, {}, {"name": 3}, {"name": "Rollup"}, {"name": "RollUp"}]}),
    (ae.emission.IonRandom, {"seed": 1, "ions": [1]}, {"seed": SEED, "ions": [None, "x", 3, [0.5], [NAN], [2**70]]}),
    (ae.emission.IonRandom(1, [1]).uniform, {}, {"columns": [*COUNT, 0]}),
    (
        ae.emission.Emissions,
        EMISSIONS,
        {
            "positions": VECTOR,
            "normals": [*VECTOR, [[0, 0, 2.0]], np.zeros((2, 3))],
            "neighbours": [None, "x", 3, np.zeros((2, 3))],
            "charge_states": [None, "x", [0], [1.5], [1, 1], [2**70]],
            "masses": [None, "x", [0.0], [NAN], [1.0, 1.0]],
            "ions": [None, "x", [0.5], [1, 1], [2**70]],
            "nearest_neighbour_distance": POSITIVE,
        },
    ),
    (
        ae.emission.Launches,
        {"positions": np.zeros((1, 3)), "velocities": np.zeros((1, 3)), "rolled": [False]},
        {"positions": VECTOR, "velocities": [*VECTOR, np.zeros((2, 3))], "rolled": [None, "x", [1], [True, True]]},
    ),
    (ae.emission.tangent_frame, {}, {"normals": VECTOR}),
    (
        ae.Hits,
        HITS,
        {
            **dict.fromkeys(("x", "y", "time_of_flight", "voltage"), COLUMN),
            "positions": ["x", 3, [1.0, 2.0], np.zeros((2, 2))],
            **dict.fromkeys(("ion", "site", "pulse_id", "multiplicity"), WHOLE),
            "pulses": [[-1, 2], [2**40, 1]],
            "outcome": [[0, 7], [-1, 0], [0.5, 0]],
            "extra": [*TABLE, {"a": 3}, {"a": object()}],
            "units": TABLE,
            "source": TEXT,
        },
    ),
    (hits.within_circle, {"radius": 3.0}, {"radius": POSITIVE, "centre": [value for value in VECTOR if value != 5]}),
    (hits.window, {}, {"voltage": [3, "ab", None, (1,), (2, 1), (NAN, 1), ("a", 1), {}]}),
    (hits.map, {}, {"bins": [*COUNT, 0, 10**6], "extent": [3, "x", (1, 2), (1, 1, 1, 1), (0, NAN, 0, 1)]}),
    (
        hits.map,
        {"bins": 4},
        {"position_step": [3, "always", (0, 1), (NAN, 1)], "like": OBJECT, "dither_seed": [1.5, -1, "x"]},
    ),
    (hits.map, {"bins": 4}, {"mask": ["x", 3, [[True]], np.ones((4, 3), int)]}),
    (ae.DetectorMap.from_hits, {}, {"hits": [*OBJECT, None]}),
    (
        ae.DetectorMap.from_array,
        {"values": np.ones((2, 2)), "x_edges": [0, 1, 2], "y_edges": [0, 1, 2]},
        {
            "values": ["x", 3, [[-1.0, 1], [1, 1]]],
            "x_edges": ["x", 3, [0, 1], [0, 2, 1], [0, 1, 5]],
            "y_edges": ["x", 3, [0, 1], [0, NAN, 1]],
            "mask": ["x", 3, np.ones((2, 2), int), np.zeros((2, 2), bool)],
            "is_counts": SWITCH,
            "source": TEXT,
        },
    ),
    (grid.smoothed, {}, {"sigma": [*NUMBER, -1.0, 100.0]}),
    (ae.maps.radial_profile, {"hits": hits, "outer": 9.0}, {"hits": [*OBJECT, None], "bins": [*COUNT, 0, 10**6]}),
    (
        ae.maps.radial_profile,
        {"hits": hits, "outer": 9.0},
        {"inner": [*NUMBER, -1.0], "outer": POSITIVE, "centre": [3, "x"]},
    ),
    (
        ae.maps.azimuthal_profile,
        {"hits": hits, "inner": 1.0, "outer": 9.0},
        {"hits": [*OBJECT, None], "bins": [*COUNT, 0]},
    ),
    (
        ae.maps.zone_line_profile,
        {"hits": hits, "rectangles": strip},
        {"hits": [*OBJECT, None], "bins": [*COUNT, 0, 10**6]},
    ),
    (ae.maps.zone_line_profile, {"hits": hits}, {"rectangles": [None, 3, "x", [], [3], NAN, dict]}),
    (ae.maps.fit_zone_line, {"profile": ring}, {"profile": [*OBJECT, None], "exponent": [*POSITIVE[1:], 1e3]}),
    (ae.maps.compare_profiles, {"first": ring, "second": ring}, {"first": [*OBJECT, None], "second": [*OBJECT, None]}),
    (
        ae.maps.Rectangle,
        {"centre": (0, 0), "angle": 0.0, "length": 9.0, "width": 9.0},
        {"centre": VECTOR, "angle": NUMBER, "length": POSITIVE, "width": POSITIVE},
    ),
    (
        ae.detection.Projection,
        {"scale": 50.0},
        {"scale": POSITIVE, "centre": VECTOR, "mirror": SWITCH, "compression": POSITIVE[1:]},
    ),
    (
        ae.Orientation,
        {"material": "Ni"},
        {
            "material": [*OBJECT, None],
            "axis": [*VECTOR, (0, 0, 0)],
        },
    ),
    (ae.Orientation.from_matrix, {"material": "Ni"}, {"matrix": [*VECTOR, 2 * np.eye(3), -np.eye(3)]}),
    (
        ae.maps.fit_orientation,
        {"material": "Ni", "planes": [(1, 1, 1), (0, 0, 1)], "places": [(0.0, 0), (9.0, 0)]},
        {
            "material": [*OBJECT, None],
            "planes": [None, 3, "x", [(0, 0, 0), (0, 0, 1)], [(0.5, 0, 0), (0, 0, 1)]],
            "places": [None, 3, "x", [(0, 0)], [(0, 0), (0, 0)], [(0, 0), (NAN, 0)]],
            "lines": [None, 3, "x", [3], NAN],
            "scale": POSITIVE[1:],
            "centre": VECTOR,
            "mirror": SWITCH[1:],
        },
    ),
    (
        ae.Registration,
        {"rotation": 0.0, "scale": 1.0, "shift": (0.0, 0.0)},
        {"rotation": NUMBER, "scale": POSITIVE, "shift": VECTOR, "mirror": SWITCH},
    ),
    (
        ae.register,
        {"simulated": grid, "measured": grid},
        {
            "simulated": [*OBJECT, None],
            "measured": [*OBJECT, None],
            "overlap": [*POSITIVE, 2.0],
            "mirrors": [3, "x", []],
        },
    ),
    (
        ae.register,
        {"simulated": grid, "measured": grid},
        {"start": [*OBJECT], "scales": ["x", NAN, -1.0, 0, INF, (2.0, 1.0), (1, 2, 3)]},
    ),
    (
        ae.maps.register_points,
        {"simulated_points": CORNERS, "measured_points": CORNERS},
        {"simulated_points": VECTOR, "measured_points": [*VECTOR, [(0, 0)] * 3], "mirror": SWITCH[1:]},
    ),
    (
        ae.simulation.Checkpoint,
        {"path": "a.h5"},
        {
            "path": [None, 3, NAN, [], "a\0b", "a.txt"],
            "minutes": [*NUMBER, -1.0],
            "ions": [*COUNT[1:], 0],
            "resume": SWITCH,
            "overwrite": SWITCH,
        },
    ),
    (ae.read_map, {}, {"path": [None, 3, NAN, [], "a\0b", "none.npz"]}),
    (
        ae.similarity,
        {"map_a": grid, "map_b": grid},
        {"map_a": OBJECT, "map_b": [*OBJECT, hits], "data_range": POSITIVE},
    ),
    (ae.maps.similarity_ceiling, {"hits": hits}, {"hits": [*OBJECT, None], "seed": SEED}),
    (
        ae.detection.Ranges,
        RANGES,
        {
            "names": [None, "Ni", 3, [], [3]],
            "low": ["x", 3, [NAN], [1.0, 2.0], [70.0]],
            "high": ["x", 3, [NAN], [1.0, 2.0], [1.0]],
            "volume": ["x", 3, [1.0, 2.0]],
            "colour": [3, "red", [], NAN],
            "composition": [3, "NiO", [3], []],
            "source": TEXT,
        },
    ),
    (ranges.index, {}, {"hits": [*OBJECT, None]}),
    (ranges.labels, {"hits": hits}, {"outside": TEXT}),
    (
        polarization_energy,
        {"polarizability": 1e-40, "voltage": 1e3, "field_factor": 3.0, "radius": 10.0, "step": 0.3},
        {"polarizability": POSITIVE, "voltage": NUMBER, "field_factor": POSITIVE, "radius": POSITIVE, "step": NUMBER},
    ),
    (
        ae.reconstruct,
        {"hits": hits, "atomic_volume": 0.011, "distance": 100.0, "evaporation_field": 35.0},
        {
            "hits": [*OBJECT, None],
            **dict.fromkeys(("atomic_volume", "distance", "evaporation_field"), POSITIVE),
            **dict.fromkeys(("field_factor", "compression"), POSITIVE[1:]),
            "efficiency": [*POSITIVE, 1.1],
            "protocol": WORD,
            "projection": WORD[1:],
            "lens": OBJECT,
            "radius": [*POSITIVE, "no such", [1.0, NAN, 1.0], [1.0, 0.0, 1.0]],
            "detector_radius": [value for value in POSITIVE if value is not None] + [0.1],
            "area": [value for value in POSITIVE if value is not None],
            "smoothing": [*COUNT, 0],
            "initial_radius": [10.0],  # not for the voltage
            "shank_angle": [3.0],
            "settings": [*OBJECT],
            "element": [3, []],
            "origins": OBJECT,
        },
    ),
    (
        ae.reconstruction.ReconstructionSettings,
        {"distance": 90.0, "atomic_volume": 0.011, "evaporation_field": 35.0},
        {"radius": ["no such", 0.0, NAN, [1.0, NAN], [[1.0]]], "element": [3, []], "lens": OBJECT},
    ),
    (
        ae.reconstruct,
        {"hits": hits, "atomic_volume": 0.011, "distance": 9.0, "radius": "shank"}
        | {"initial_radius": 30.0, "shank_angle": 5.0},
        {"initial_radius": POSITIVE, "shank_angle": [*NUMBER, -1.0, 45], "evaporation_field": [30.0]},
    ),
    (
        ae.reconstruction.fit_shank,
        {
            "hits": hits,
            "lens": ae.detection.LocalElectrode(40e3, 20e3, 5.0),
            "atomic_volume": 0.011,
            "distance": 100.0,
        },
        {"hits": [*OBJECT, None], "lens": [*OBJECT, None]},
    ),
    (
        ae.detection.field_of_view,
        {
            "lens": ae.detection.LocalElectrode(40e3, 20e3, 5.0),
            "tip": ae.Tip("Ni", apex_radius=2.0),
            "detector": ae.Detector(distance=90.0, width=45.0),
        },
        {"lens": [*OBJECT, None], "tip": [*OBJECT, None], "detector": [*OBJECT, None]},
    ),
    (
        ae.reconstruction.checks,
        {"reconstruction": ae.reconstruct(hits, atomic_volume=0.011, distance=100.0, radius=30.0)},
        {"reconstruction": [*OBJECT, None], "radius": POSITIVE},
    ),
    (
        ae.evaporation.conditions,
        {"composition": {"Al": 1.0}},
        {
            "composition": [*TABLE, None, {}, {"Al": 0.5}, {"Al": NAN}],
            "temperatures": [None, "x", [0.0], [NAN], 1e9],
            "pulse_fractions": [None, "x", [0.0], [NAN], 1.5],
            "law": OBJECT,
            "control": OBJECT,
        },
    ),
    (ae.detection.Cooling, {"temperature": 50.0, "temperature_rise": 100.0, "time_constant": 2.0}, {}),
    (ae.studies.VisibilitySettings, {"analysis": "clusters.py:pairs"}, {}),
    (
        ae.Reconstruction.errors,
        {"self": ae.reconstruct(hits, atomic_volume=0.011, distance=100.0, radius=30.0), "truth": np.eye(3)},
        {
            "truth": [None, *VECTOR[1:], np.zeros((2, 3))],
            "fit": [None, 3, "shift", ["scale"], [3], NAN],
        },
    ),
    (
        ae.reconstruction.compression_from_poles,
        {"crystal_angles": [54.7, 35.3], "observed_angles": [35.0, 22.0]},
        {
            "crystal_angles": [None, "x", 3, [], [NAN, 1.0], [0.0, 1.0], [200.0, 1.0]],
            "observed_angles": [None, "x", 3, [1.0], [NAN, 1.0], [-1.0, 1.0]],
        },
    ),
    (
        ae.reconstruction.distribution_map,
        {"positions": np.indices((3, 3, 3)).reshape(3, -1).T * 0.2},
        {
            "positions": [*VECTOR, np.zeros((1, 3)), np.zeros((4, 2))],
            "axis": [None, "x", 1j, 3, -1, 0.5, NAN, (0, 0, 0), (1.0, NAN, 0), (1, 1), object()],
            "lateral": POSITIVE,
            "reach": POSITIVE,
            "bins": [*COUNT, 3],
            "centre": [value for value in VECTOR if value is not None],
            "radius": [value for value in POSITIVE if value is not None],
            "max_pairs": [*COUNT, 0],
            "seed": COUNT,
        },
    ),
    (ae.emission.ChargeRatio, {"threshold": 0.9}, {}),
    (ae.emission.Migration, {"cohesive_energy": 4.44, "field": 35.0}, {}),
    (
        ae.emission.Mixture,
        {"perturbations": (ae.RollUp(0.2), ae.Unperturbed())},
        {
            "perturbations": [None, 3, "x", (), (ae.RollUp(0.2),), (ae.RollUp(0.2), "x")],
            "weights": [3, "x", (1.0,), (1.0, -1.0), (1.0, NAN)],
        },
    ),
    (
        ae.simulation.WideDesign,
        {"place": 1, "velocity": 2, "height": 1, "mixed": 2},
        {
            **{name: [*COUNT, 7] for name in ("place", "velocity", "height", "mixed")},
        },
    ),
    (ae.ResponseSettings.wide, {}, {"height": [*POSITIVE, 2.0], "energy_limit": POSITIVE, "bound": POSITIVE}),
    (
        ae.analysis.ImagingGas,
        {"name": "Xe", "ionisation_energy": 12.13, "field": 15.0},
        {"ionisation_energy": POSITIVE, "field": POSITIVE},
    ),
    (
        ae.maps.pole_profile,
        {"map": grid, "projection": ae.detection.Projection(10.0, centre=(10.0, 10.0))},
        {"map": [*OBJECT, None], "projection": [*OBJECT, None], "radii": [3, "x", [1.0], [2.0, 1.0], [NAN, 1.0]]},
    ),
    (
        ae.maps.pole_line_profile,
        {
            "map": grid,
            "projection": ae.detection.Projection(10.0, centre=(10.0, 10.0)),
            "pole": (0, 0, 1),
            "toward": (1, 0, 1),
        },
        {"map": [*OBJECT, None], "projection": [*OBJECT, None], "pole": [*VECTOR, (0, 0, 0)], "bins": [*COUNT, 0]},
    ),
    (ae.maps.effective_ions, {}, {"map": [*OBJECT, None]}),
    (ae.io.read_grid, {}, {"path": [None, 3, NAN, [], "a\0b", "none.csv"]}),
    (ae.read_tip, {}, {"path": [None, 3, NAN, [], "a\0b", "none.lmp"]}),
    (
        ae.maps.score_surface,
        {"simulated": grid, "measured": grid, "scales": (0.9, 1.1)},
        {
            "simulated": [*OBJECT, None],
            "scales": [None, "x", (0.0, 1.0), (2.0, 1.0)],
            "rotations": [None, "x", (2.0, 1.0)],
        },
    ),
    (ae.maps.register_distortion, {"simulated": grid, "measured": grid}, {"registration": [*OBJECT, None]}),
    (
        ae.maps.Distortion,
        {"degree": 1, "centre": (0.0, 0.0), "radius": 1.0, "coefficients": (1.0,)},
        {"centre": VECTOR},
    ),
    (ae.fit.EnergyGrid, {}, {"mechanism": WORD, "means": [3, "x", [], [NAN], [0.0], [2.0, 1.0]]}),
    (ae.load, {}, {"path": [None, 3, NAN, [], "a\0b", "none.h5"]}),
    (ae.read, {}, {"path": [None, 3, NAN, [], "a\0b", "none.epos"]}),
    (ae.io.read_ranges, {}, {"path": [None, 3, NAN, [], "a\0b", "none.rrng"]}),
    (ae.write, {"path": "a.epos", "hits": hits}, {"path": [None, 3, NAN, [], "a\0b", "a.txt", "a.h5"]}),
    (ae.write, {"path": "a.epos", "hits": hits}, {"hits": [*OBJECT, None], "format": [3, True, b".pos", ".txt"]}),
    (
        ae.emission.charge_state_ratio,
        {"element": "Ni", "charge": 1, "field": 35.0},
        {
            "element": WORD,
            "charge": [None, "x", 0, 1.5, 9],
            "field": [None, "x", 1j, NAN, [1.0, NAN], [[1.0], [1.0, 2.0]]],
        },
    ),
    (
        ae.emission.field_of_ratio,
        {"element": "Ni", "charge": 1, "ratio": 0.1},
        {"element": WORD, "charge": [None, "x", 0, 1.5, 9], "ratio": [None, "x", NAN, -1.0]},
    ),
    (
        ae.analysis.tunnel_factor,
        {"field": 44.0, "ionisation_energy": 24.6},
        {"field": [None, "x", 1j, NAN, 0, -1.0, [1.0, 0.0], 10**400], "ionisation_energy": POSITIVE},
    ),
    (
        ae.analysis.critical_distance,
        {"field": 44.0, "ionisation_energy": 24.6},
        {"field": POSITIVE, "ionisation_energy": POSITIVE, "work_function": POSITIVE},
    ),
    (ae.maps.plane_normals, {"material": nickel, "planes": [(1, 1, 1)]}, {"planes": VECTOR}),
    (ae.maps.direction_normals, {"material": nickel, "directions": [(1, 1, 1)]}, {"directions": VECTOR}),
    (ae.maps.poles, {"material": nickel}, {"material": OBJECT, "families": COUNT}),
    (ae.maps.zones, {"material": nickel}, {"material": OBJECT}),
    (ae.maps.point_group, {"structure": "fcc"}, {"structure": WORD}),
    (ae.maps.pole_symmetry, {"material": nickel, "direction": (1, 1, 1)}, {"direction": VECTOR}),
    (
        ae.maps.symmetry_about_axis,
        {"material": nickel, "orientation": np.eye(3)},
        {"orientation": [None, "x", 3]},
    ),
    (ae.specimen.atom_density, {"structure": "fcc", "a": 0.35}, {"structure": WORD, "a": POSITIVE}),
    (ae.specimen.nearest_neighbour_distance, {"structure": "fcc", "a": 0.35}, {"structure": WORD}),
    (ae.specimen.rotation_to_axis, {"material": nickel, "axis": (1, 1, 1)}, {"axis": VECTOR, "rotation": NUMBER}),
    (
        ae.detection.mass_to_charge,
        {"voltage": 5e3, "time_of_flight": 600.0, "x": 0.0, "y": 0.0, "distance": 90.0},
        {"distance": POSITIVE, "curved": SWITCH},
    ),
    (
        ae.detection.LocalElectrode,
        {"distance": 40e3, "aperture": 20e3, "shank_angle": 5.0},
        {"profile": [3, "x", [1.0], [(0.0, 20.0)], [(0.0, 20.0), (0.0, 30.0)], [(0.0, 20.0), (50.0, 10.0)]]},
    ),
    (RealUnits, {"field_reference": "cap", "operating_field": 35.0}, {}),
    (CostEstimate, {"ions": 10}, {}),
]
NEEDS_A_RUN = [
    (
        ae.Simulation,
        {"tip": shell, "n_threads": 1},
        {
            "tip": [*OBJECT, None],
            "voltage": [*POSITIVE, 1e9],
            "seed": SEED,
            "n_threads": [value for value in COUNT if value is not None] + [0, 10**6],
            **dict.fromkeys(("detector", "law", "charge_settings", "flight_settings", "response_settings"), OBJECT),
            "monitor": OBJECT,
            "rule": OBJECT,
        },
    ),
    (
        "simulation.run",
        {"n_ions": 1, "progress": False},
        {
            "n_ions": [*COUNT, 0],
            "emissions": [None, 3, "x", NAN, [3], ae.Unperturbed()],
            "responses": SWITCH,
            "progress": [value for value in SWITCH if value is not None],
            "batch_size": [*COUNT, 0],
        },
    ),
    (
        ae.evaporation.Emitter,
        {"tip": shell},
        {"tip": [*OBJECT, None], "voltage": POSITIVE, "law": OBJECT, "settings": OBJECT},
    ),
    ("emitter.field_at", {"points": [[0.0, 0, 9]]}, {"points": VECTOR, "opening_angle": [*NUMBER, -1.0, 3.0]}),
    ("emitter.potential_at", {"points": [[0.0, 0, 9]]}, {"points": VECTOR, "opening_angle": [*NUMBER, -1.0, 3.0]}),
    ("emitter.relax", {}, {"tolerance": [value for value in POSITIVE if value is not None]}),
    ("emitter.evaporate", {}, {"max_events": [*COUNT, 0]}),
    ("run.hits", {"perturbation": ae.Unperturbed()}, {"perturbation": [*OBJECT, None], "by_response": SWITCH}),
    ("simulation.run", {"n_ions": 1, "progress": False}, {"checkpoint": [True, 3, NAN, [], "a\0b", "a.txt"]}),
    (
        "run.at_evaporation_field",
        {},
        {
            "field_reference": WORD,
            "operating_field": [value for value in POSITIVE if value is not None],
            "flight_charges": [0, -1, 1.5, "x", NAN, {"Al": 1}, {"Ni": 0}],
            "control": [*OBJECT, dict],
            "timing": [*OBJECT, dict],
            "smoothing": [*COUNT, 0],
            "field_factor": [value for value in POSITIVE if value is not None],
            "seed": [value for value in SEED if value is not None],
        },
    ),
    ("run.on_detector", {}, {"detector": [*OBJECT, None]}),
    (
        "real.record",
        {"instrument": ae.Instrument()},
        {"perturbation": OBJECT, "seed": [value for value in SEED if value is not None]},
    ),
    (ae.analysis.fit_caps, {"windows": 1}, {"run": [*OBJECT, None]}),
    (ae.reconstruction.origin_table, {}, {"runs": [*OBJECT, None]}),
    (ae.fit.fit_tips, {"measured": hits}, {"runs": [*OBJECT, None]}),
    (
        ae.fit.fit_radius,
        {
            "measured": grid,
            "projection": ae.detection.Projection(10.0),
            "perturbations": ae.Unperturbed(),
            "plane": (1, 1, 1),
        },
        {"runs": [*OBJECT, None]},
    ),
    (ae.analysis.field_ion_image, {}, {"emitter": [*OBJECT, None]}),
    (target_shares, {"sharpness": 0.1}, {"emissions": [*OBJECT, None]}),
    (ae.analysis.image_compression, {}, {"run": [*OBJECT, None]}),
    (ae.analysis.field_factor, {}, {"run": [*OBJECT, None]}),
    (ae.analysis.evaporation_fields, {}, {"run": [*OBJECT, None]}),
    (ae.analysis.evaporation_voltages, {}, {"run": [*OBJECT, None]}),
    (ae.reconstruction.run_constants, {}, {"run": [*OBJECT, None]}),
    (ae.analysis.lateral_tracks, {"ions": [0], "energies": [0.1]}, {"run": [*OBJECT, None]}),
    (ae.analysis.rollup_tracks, {"ions": [0], "energies": [0.1]}, {"run": [*OBJECT, None]}),
    (ae.fit_energies, {"measured": hits}, {"run": [*OBJECT, None]}),
    ("tracks", {"energies": [0.1]}, {"ions": [None, 3, "x", [], [0.5], [-1], [99], [2**70]]}),
    ("tracks", {"ions": [0]}, {"energies": [None, 3, "x", [], [NAN], [-1.0], [99.0]]}),
    ("fit_energies", {"measured": hits}, {"measured": [*OBJECT, None]}),
    ("run.save", {}, {"path": [None, 3, NAN, [], "a\0b", "no such folder/a.h5"]}),
]
# where the sentence names the argument by another word: part of a tip by itself, of the whole by the sum
OTHER_WORDS = {
    "checkpoint": "path|file|checkpoint",
    "path": "path|file|cannot (read|write)|format",
    "format": "format",
    "hits": "hits",
    "name": "name",
    "settings": "settings|perturbation or distribution|RollUp needs",
    "low": "low|high",
    "high": "high|low",
    "positions": "positions",
    "evaporation_field": "evaporation_field",
    "opening_angle": "opening_angle|relaxation_angle",
    "patch_radius": "patch_radius|update_radius",
    "inner": "inner|outer",
    "names": "names|Ranges",
    "solutes": "solutes|Cu",
    "second": "second|material",
    "elements": "elements|Ni",
    "material": "material",
}


def bad_values(setting, default):
    """Bad values of a field of settings: of another type, and outside its declared bounds."""
    values = {"float": NUMBER, "int": COUNT, "bool": SWITCH}.get(setting.kind, [])
    values = WORD if re.fullmatch(r"\{.*\}", setting.kind) else values
    steps = {">": 0, ">=": -1, "from": -1, "<": 0, "<=": 1, "to": 1}
    for sign, bound in re.findall(r"(>=?|<=?|from|to) (\S+)", setting.bounds):
        beyond = float(bound) + steps[sign] * max(1.0, abs(float(bound)))
        values = [*values, beyond if setting.kind == "float" else round(beyond)] if values else []
    return [value for value in values if value is not None or default is not None]


SPACES = [thing for thing in (getattr(ae, name) for name in ae.__all__) if inspect.ismodule(thing)]
PUBLIC = {name: getattr(place, name) for place in (ae, *SPACES) for name in getattr(place, "__all__", ())}


def of_settings(cases):
    """The same for all classes of settings by their declarations; `cases` have the arguments that they need."""
    good = {function: arguments for function, arguments, _ in reversed(cases)}
    for cls in (thing for name, thing in PUBLIC.items() if name != "Registration"):  # results of fits are not checked
        if isinstance(cls, type) and declared(cls):
            defaults = {item.name: item.default for item in fields(cls)}
            bad = {name: bad_values(setting, defaults[name]) for name, setting in declared(cls).items()}
            yield cls, good.get(cls, {}), {name: values for name, values in bad.items() if values}


def calls(cases):
    for function, good, bad in cases:
        name = function if isinstance(function, str) else getattr(function, "__qualname__", repr(function))
        for argument, values in bad.items():
            yield pytest.param(function, good, argument, values, id=f"{name}-{argument}")


def check(function, good, argument, values, folder):
    """Every bad value gives one sentence with the name of the argument, and the value or its shape."""
    for value in values:
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("error", RuntimeWarning)  # nothing is computed with it first
                function(**(good | {argument: value}))
        except ValueError as error:
            sentence = str(error)
        else:
            pytest.fail(f"{argument}={short_text(value)} is taken")
        value = short_text(value) if isinstance(value, int) else value  # too long to print
        assert re.search(OTHER_WORDS.get(argument, argument), sentence), (value, sentence)
        assert "\n" not in sentence and len(sentence) < 420, (value, sentence)
        assert re.search("got|is (named|missing|not known)|(cannot|cannot be) (read|written|write)", sentence), (
            value,
            sentence,
        )
        listed = isinstance(value, list | tuple | dict | np.ndarray)  # told by their shape or a member
        assert listed or short_text(value) in sentence or str(value) in sentence, (value, sentence)
    assert not os.listdir(folder)


@pytest.mark.parametrize(("function", "good", "argument", "values"), list(calls([*CASES, *of_settings(CASES)])))
def test_bad_arguments_are_refused_by_name(tmp_path, monkeypatch, function, good, argument, values):
    monkeypatch.chdir(tmp_path)
    check(function, good, argument, values, tmp_path)


@pytest.mark.parametrize(("function", "good", "argument", "values"), list(calls(NEEDS_A_RUN)))
def test_bad_arguments_of_a_simulation_are_refused_by_name(
    tmp_path, monkeypatch, ready, function, good, argument, values
):
    monkeypatch.chdir(tmp_path)
    if isinstance(function, str):
        owner, _, method = function.partition(".")
        function = getattr(ready[owner], method) if method else ready[owner]
    check(function, good, argument, values, tmp_path)


# names of these are tried in the tests of their packages
OTHER_PACKAGES = (ae.plot, ae.explore, ae.studies, ae.config)
# made by the package
MADE = {"FileError", "TruncatedFile", "Outcome", "StopReason", "RunInterrupted", "RunNotSaved", "Run", "EmitterState"}
MADE |= {"Reconstruction", "Study", "ZoneLine", "History", "CapHistory", "Ring", "RadiusFit", "TipFit", "Distortion"}
MADE |= {"DistortionGrid", "FittedOrientation", "Similarity", "Batch", "Lens"}
# for extensions, which call them with arrays of the package
ARRAYS = {"charge_probabilities", "course", "course_of_charges", "draw_isotopes", "field_of_counts", "ion_charges"}
ARRAYS |= {"launch_tangentially", "ratio_of_counts", "rollup_direction", "lattice_sites_in", "BondField"}
ARRAYS |= {"Detection", "charge_residuals", "surface_after", "roll_ups"}


def is_result(thing):
    """Whether a class holds results, or is an interface."""
    if not isinstance(thing, type) or declared(thing):
        return False
    return is_dataclass(thing) or hasattr(thing, "_fields") or getattr(thing, "_is_protocol", False)


def test_every_public_name_with_arguments_is_in_the_table():
    """A new public class or function is in the table above, or it is said here why not."""
    tried = {getattr(function, "__self__", function) for function, _, _ in (*CASES, *of_settings(CASES), *NEEDS_A_RUN)}
    tried |= {ae.Run, ae.Simulation}
    taken = {*MADE, *ARRAYS, "Unperturbed", "Union"}  # no arguments; positional arguments only, in test_regions
    taken |= {"chunks", "precipitate_errors", "likeness"}  # in test_chunks, test_precipitate, test_verdict
    taken |= {"write_nodes", "write_types", "describe"}  # in test_tapsim_nodes, test_main
    taken |= {"index", "indexing", "MasterPattern", "master_patterns", "master_pattern"}  # in tests/maps
    taken |= {"Measurement", "constants_of", "settings_of"}  # in tests/fit
    missing = {
        name
        for place in (ae, *SPACES)
        for name in getattr(place, "__all__", ())
        if place not in OTHER_PACKAGES
        for thing in [getattr(place, name)]
        if callable(thing) and name not in taken and thing not in tried and not is_result(thing)
    }
    assert sorted(missing) == []


# ---- what does not fit together --------------------------------------------------------------------------------------


def test_a_detector_behind_the_end_of_the_flights():
    with pytest.raises(ValueError, match="distance"):
        ae.Simulation(shell, detector=ae.Detector(distance=0.001))


def test_more_ions_than_atoms_are_said_before_the_run_starts():
    simulation = ae.Simulation(shell, n_threads=1)
    shell_and_below = round(simulation.tip.max_ions)
    with pytest.warns(UserWarning, match=f"n_ions.*{shell_and_below:,}"):
        with pytest.raises(KeyboardInterrupt):
            simulation.run(100_000, emissions=(_Interrupting(),), progress=False)


class _Interrupting:
    def launch(self, emissions, random):
        raise KeyboardInterrupt


@pytest.mark.parametrize("shape", [{}, {"shank_angle": 20.0}, {"base": "flat", "shank_length": 6.0}])
def test_the_atoms_that_may_leave_a_shell_are_those_of_the_whole(shape):
    whole, part = ae.Tip(nickel, 3.0, **shape), ae.Tip(nickel, 3.0, **shape, depth=1.2)
    assert whole.max_ions == whole.evaporable.sum()
    # the surface is a layer of atoms or none: 0.1 nm of 3 nm, on three sides
    assert part.max_ions == pytest.approx(whole.max_ions, rel=0.03)
    assert part.max_ions > 1.2 * part.evaporable.sum()


def test_unknown_materials_come_with_the_nearest_known():
    with pytest.raises(ValueError, match=r"'Nickel'.*'Ni'"):
        ae.Tip("Nickel", 5.0)


# ---- memory ----------------------------------------------------------------------------------------------------------

PEAK = """
import json, sys
import apt_evap as ae
ae.Simulation, ae.Tip  # names are loaded when they are first used
def memory(name):
    with open("/proc/self/status") as lines:
        return next(int(line.split()[1]) * 1024 for line in lines if line.startswith(name))
before = memory("VmRSS")
tip = ae.Tip("Ni", **json.loads(sys.argv[1]))
emitter = ae.Simulation(tip, n_threads=1).emitter
print(json.dumps([memory("VmHWM") - before, len(tip), len(emitter)]))
"""


@pytest.mark.skipif(not Path("/proc/self/status").exists(), reason="Linux says how much memory was used")
@pytest.mark.parametrize("shape", [{"apex_radius": 6.0}, {"apex_radius": 8.0, "depth": 2.0}])
def test_the_memory_foreseen_is_the_memory_taken(shape, monkeypatch):
    done = subprocess.run(
        [sys.executable, "-P", "-c", PEAK, json.dumps(shape)],
        capture_output=True,
        text=True,
        check=True,
        env=os.environ | {"PYTHONPATH": str(Path(ae.__file__).parents[1])},
    )
    peak, atoms, surface = json.loads(done.stdout)

    class Seen(Exception):
        """Carries the numbers of atoms, before a specimen is built of them."""

    def note(*counts):
        raise Seen(*counts)

    monkeypatch.setattr("apt_evap.specimen.tip.check_memory", note)
    with pytest.raises(Seen) as seen:
        ae.Tip("Ni", **shape)
    foreseen = seen.value.args
    assert foreseen[0] == pytest.approx(atoms, rel=0.03)
    assert foreseen[1] == pytest.approx(surface, rel=0.15)  # steps and kinks are not in the area
    assert memory.needed_memory(*foreseen) == pytest.approx(peak, rel=0.3)


def test_what_does_not_fit_is_refused_before_it_is_built(monkeypatch):
    monkeypatch.setattr(memory, "_available_memory", lambda: 8e9)
    with pytest.raises(ValueError, match=r"e\+08 atoms .*8 GB.* depth"):
        ae.Tip("Ni", 10.0, shank_length=1000.0)
    with pytest.raises(ValueError, match="8 GB"):
        ae.Tip("Ni", 1e6, depth=1.2)
    assert len(ae.Tip("Ni", 1.5)) > 0
    monkeypatch.setattr(memory, "_available_memory", lambda: 1e6)
    with pytest.raises(ValueError, match=r"n_threads=64.*0.001 GB"):
        ae.Simulation(shell, n_threads=64)


# ---- what things say of themselves -----------------------------------------------------------------------------------


def test_everything_says_in_one_line_what_it_holds(ready, tmp_path):
    simulation, run, emitter = (ready[name] for name in ("simulation", "run", "emitter"))
    (tmp_path / "a.toml").write_text('[tip]\nmaterial = "Ni"\napex_radius = "6 a"\n[simulation]\nions = 60\n')
    launches = ae.Unperturbed().launch(run.emissions, ae.emission.IonRandom(1, run.emissions.ions))
    told = [
        (simulation, ["Simulation", "1000 V", "seed 0", "atoms of Ni [0 0 1]", "300 mm at 100 mm"]),
        (shell, ["Tip", f"{len(shell):,} atoms of Ni [0 0 1]", "1.5 nm", "to a depth of 1.2 nm"]),
        (emitter, ["Emitter", f"{len(emitter):,} surface atoms", "1000 V"]),
        (run, ["Run", "12 ions of Ni", "1000 V", "flagged"]),
        (run.hits(ae.Unperturbed()), ["Hits", "12 ions", "detected", "Unperturbed()", "time_of_flight"]),
        (run.emissions, ["Emissions", "12 atoms", "neighbour"]),
        (launches, ["Launches", "12 ions", "0 of them rolled up"]),
        (grid, ["DetectorMap", "densities", "20 x 20 bins of 1 x 1 mm"]),
        (ranges, ["Ranges", "1 of Ni"]),
        (nickel, ["Material", "Ni", "fcc", "0.352", "35.0"]),
        (ae.Detector(), ["Detector", "distance=100.0", "width=300.0"]),
        (read_config(tmp_path / "a.toml"), ["Config", "a.toml", "60 ions of Ni", "2.112 nm", "roll-up"]),
        (ae.RollUp(ae.TruncatedNormal(0.3, 0.1)), ["RollUp(TruncatedNormal(0.3, 0.1))"]),
        (ae.emission.IonRandom(1, [0, 1]), ["IonRandom", "seed=1", "2 ions"]),
        (ae.evaporation.ChargeSettings(), ["ChargeSettings", "tolerance=", "opening_angle=0.4"]),
        (ae.FlightSettings(), ["FlightSettings", "tolerance=", "max_steps=500"]),
        (ae.ResponseSettings(), ["energy_limit=1.5", "bound=0.2", "degree=4"]),
    ]
    for thing, words in told:
        assert all(word in repr(thing) for word in words), repr(thing)
        assert "\n" not in repr(thing) and len(repr(thing)) < 260 and "0x" not in repr(thing)
    assert repr(run.responses) == "<Responses: 12 ions, 15 coefficients from the site, 10 rolled up>"
    assert "evaporated atoms" in repr(emitter.evaporate(1))
