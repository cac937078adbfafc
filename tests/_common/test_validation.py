"""Validation: every public argument, given something bad, is refused in one sentence with its name and the value."""

import inspect
import json
import math
import os
import re
import subprocess
import sys
import warnings
from dataclasses import is_dataclass
from functools import partial
from operator import attrgetter
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

import apt_evap as ae
from apt_evap._common import memory
from apt_evap._common.codec import declared
from apt_evap._common.validation import (
    check_array,
    check_choice,
    check_count,
    check_kind,
    check_name,
    check_number,
    check_pairs,
    check_seed,
    check_sequence,
    check_switch,
    check_values,
    short_text,
)
from apt_evap.detection.hits import Hits
from apt_evap.emission.emissions import Emissions
from apt_evap.emission.perturbations import perturbation_of
from apt_evap.emission.surface_frame import tangent_frame, target_shares
from apt_evap.maps.crystallography.directions import direction_normals, plane_normals
from apt_evap.maps.noise import effective_ions
from apt_evap.maps.registration.polynomial import Distortion
from apt_evap.simulation.config.cost_estimate import CostEstimate
from apt_evap.simulation.config.simulation_file import read_config
from apt_evap.simulation.ion_image import tunnel_factor
from apt_evap.simulation.real_units import RealUnits
from apt_evap.simulation.voltage_history import evaporation_fields, evaporation_voltages, smoothed_history
from apt_evap.specimen.lattice import nearest_neighbour_distance
from apt_evap.specimen.shape import TaperedCap
from apt_evap.specimen.symmetry import point_group, pole_symmetry, symmetry_about_axis

NAN, INF = math.nan, math.inf
NEITHER = [None, "x", "5", True, 1j, [1.0], {}, b"x", object(), np.array([1.0, 2.0])]  # no number
WILD = [NAN, INF, -INF, 1e300, 10**400, 10**5000]  # no number to compute with
COLUMN = ["x", 3, 1j, [[1.0], [2.0]], ["a", "b"]]
WHOLE = [[0.5, 1], [NAN, 1], [2**70, 1]]


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


# ---- the checks ------------------------------------------------------------------------------------------------------


def refused(function, value, name):
    """The sentence with which a value is refused: one line with the name of the argument."""
    with warnings.catch_warnings():
        warnings.simplefilter("error", RuntimeWarning)  # nothing is computed with it first
        try:
            result = function(value)
        except ValueError as error:
            sentence = str(error)
        else:
            pytest.fail(f"{name}={short_text(value)} is taken: {short_text(result)}")
    shown = short_text(value)
    assert re.search(OTHER_WORDS.get(name, name), sentence), (shown, sentence)
    assert "\n" not in sentence and len(sentence) < 420, (shown, sentence)
    assert re.search("got|is (named|missing|not known)|cannot (be )?(read|written|write)", sentence), sentence
    listed = isinstance(value, list | tuple | dict | np.ndarray)  # described by its shape or a member
    assert listed or shown in sentence or str(value) in sentence, (shown, sentence)
    return sentence


# a check, and what it refuses beside the values of another type
CHECKS = {
    "number": (check_number, NEITHER + WILD),
    "positive": (partial(check_number, above=0), [*NEITHER, *WILD, 0, -1.5, np.float32(0.0)]),
    "bounded": (partial(check_number, at_least=1, below=2), [*NEITHER, *WILD, 0.99, 2, 2.0]),
    "count": (check_count, [*NEITHER, *WILD, 1.5, -1, 2**80, np.float64(2.0)]),
    "few": (partial(check_count, at_least=1, at_most=9), [*NEITHER, 0, 10]),
    "seed": (check_seed, [*NEITHER, *WILD, 1.5, -1, 2**64]),
    "switch": (check_switch, [None, "no", 0, 1.0, [], np.array([True])]),
    "word": (partial(check_choice, known=("low", "high")), [None, True, 3, NAN, [], b"x", "", "lower", "Low"]),
    "hits": (partial(check_kind, kind=ae.Hits, expected="Hits"), [None, True, "x", 0, {}, object(), dict, ae.Hits]),
    "save": (partial(check_kind, kind="save", expected="a run"), [None, "x", object(), ae.Run]),
    "title": (check_name, [None, True, 3, NAN, [], b"x", "", "x" * 101, "a\nb", "a\tb", "\x1b[1m", "\u2028", "\ud800"]),
    "items": (partial(check_sequence, expected="numbers"), [None, True, 3, NAN, "x", b"x", {}, object()]),
    "pairs": (partial(check_pairs, expected="a mapping"), [None, True, "x", 3, NAN, [1], [(1, 2, 3)], object()]),
    "vector": (
        partial(check_array, shape=(3,)),
        [None, "x", ("1", "2", "3"), 1j, 5, [], [1.0, NAN, 0], [1.0, INF, 0], [10**400, 0, 0], [[1.0], [2.0]], [0, 1]],
    ),
    "rows": (partial(check_array, shape=("n", "n")), [np.zeros((2, 3)), np.zeros(4), [[1.0, NAN], [0, 0]], 1.0]),
    "whole": (partial(check_array, shape=("n",), dtype=np.int64), ["x", 3, [0.5, 1], [NAN, 1], [2**70, 1]]),
    "mask": (partial(check_array, shape=("n",), dtype=bool), [[0, 1], np.ones(2, int), [0.5], "x"]),
    "numbers": (check_values, [None, "x", True, 1j, object(), {}, [1.0, NAN], INF, [[1.0], [1.0, 2.0]]]),
}


@pytest.mark.parametrize("name", CHECKS)
def test_a_check_refuses_what_is_wrong(name):
    check, wrong = CHECKS[name]
    for value in wrong:
        refused(partial(check, name=name), value, name)


@pytest.mark.parametrize(
    ("name", "value", "result"),
    [
        *(("number", value, 1.5) for value in (1.5, np.float32(1.5), np.float64(1.5))),
        ("positive", 5, 5.0),
        ("bounded", 1, 1.0),
        *(("count", value, 7) for value in (7, np.int8(7), np.uint64(7))),
        ("few", 9, 9),
        ("seed", 2**64 - 1, 2**64 - 1),
        *(("switch", value, True) for value in (True, np.bool_(True))),
        ("word", "low", "low"),
        ("title", "x" * 100, "x" * 100),
        ("items", range(2), (0, 1)),
        ("pairs", {"a": 1}, [("a", 1)]),
        ("pairs", [["a", 1]], [("a", 1)]),
    ],
)
def test_a_check_returns_the_plain_value(name, value, result):
    returned = CHECKS[name][0](value, name=name)
    assert returned == result and type(returned) is type(result)


def test_arrays_are_of_one_type_and_in_one_piece():
    vector, whole, mask = (CHECKS[name][0] for name in ("vector", "whole", "mask"))
    assert vector([1, 2, 3], name="a").dtype == np.float64
    assert vector(np.arange(6.0)[::2], name="a").flags.c_contiguous
    assert whole([1.0, 2.0], name="a").dtype == np.int64 and mask([True], name="a").dtype == bool
    assert check_values([[1, 2]], "a").tolist() == [[1.0, 2.0]] and check_values(NAN, "a", finite=False).shape == ()


# ---- every public argument -------------------------------------------------------------------------------------------


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
ranges = ae.spectra.Ranges(**RANGES)
ring = ae.maps.radial_profile(hits, outer=9.0)
strip = ae.maps.Rectangle((0.0, 0.0), 0.0, 20.0, 20.0)
azimuths = ae.maps.ring_statistics(
    grid, ae.detection.Projection(10.0, centre=(10.0, 10.0)), rings=[(5.0, 40.0)], sectors=4
)[0]
CORNERS = [(0.0, 0.0), (1.0, 0.0), (0.0, 1.0)]
shell = ae.Tip(**TIP)


@pytest.fixture(scope="session")
def ready():
    """A simulation, its run, and the ions on file."""
    simulation = ae.Simulation(shell, n_threads=1)
    run = simulation.run(12, progress=False)
    bound = {
        "fit_energies": partial(ae.fit_energies, run),
        "lateral_tracks": partial(ae.simulation.lateral_tracks, run),
    }
    return {
        "simulation": simulation,
        "run": run,
        "real": run.at_evaporation_field(field_reference="site"),
        "emitter": simulation.emitter,
        "tracks": bound["lateral_tracks"],
        "fit_energies": bound["fit_energies"],
    }


def row(function, good=None, positive="", **special):
    """What is called, its good arguments, arguments that must be above zero, and wrong values by their meaning.

    Values of another type than declared are tried for every argument; None instead of a list: for this one not.
    """
    return function, good or {}, positive, special


CASES = [
    row(ae.Material, MATERIAL, name=[""]),
    row(ae.material, {"name": "Ni"}, "a", name=["ni", "Xx"]),
    row(
        ae.Tip,
        TIP,
        "apex_radius shank_length depth",
        material=["Unobtainium"],
        apex_radius=[0.5, 1e9],
        axis=[(0, 0, 0), (1, 1)],
        shank_angle=[-1.0, 45, 90.0],
        shank_length=[1e9],
        depth=[0.1],
    ),
    row(ae.Tip, TIP | {"solutes": {"Cu": 0.1}, "seed": 1}, solutes=[{"Cu": 2.0}, {"Cu": "half"}, {3: 0.1}]),
    row(
        ae.Tip.from_positions,
        ATOMS,
        "neighbour_radius surface_threshold",
        positions=[np.zeros((3, 2)), [[0, 0, NAN]], np.zeros((1, 3))],
        species=[[0.5] * 125, [0] * 124, [-1] * 125, [1] * 125, [2**40] * 125, [NAN] * 125],
        elements=["Ni", [3]],
        evaporable=[[True], np.ones(125, int)],
        neighbour_radius=[1e4],
        surface_threshold=[1e4],
    ),
    row(
        ae.specimen.Phase,
        {"name": "matrix", "material": nickel},
        name=[""],
        material=["Unobtainium"],
        axis=[(0, 0, 0)],
        order=["L1_2"],
        solutes=[{"Cu": 2.0}, {"Cu": "half"}, {3: 0.1}],
        evaporation_field=[[1.0], 0, -1.0, 35e9, {"Al": 3.0}, {"Ni": "x"}],
    ),
    row(ae.Tip, {"phases": [ae.specimen.Phase("m", nickel)], "apex_radius": 1.5}, phases=[[3], [nickel]]),
    row(ae.specimen.Segregation, {"bulk": 0.1, "peak": 0.2, "width": 1.0}),
    row(ae.specimen.Segregation, {"bulk": 0.1, "peak": 0.2, "width": 1.0}, region=[len]),
    row(ae.specimen.Superlattice, {"prototype": "B2", "second": "Al"}, second=["Unobtainium", {"Al": 0.5}]),
    row(ae.specimen.UnitCell, {"sites": ("Al",)}, sites=[[3], {"Al": 1}], cells=[(1, 1), (0, 1, 1), (2, 2, 2)]),
    row(ae.specimen.Sphere, {"centre": (0, 0, 0), "radius": 1.0}),
    row(ae.specimen.Ellipsoid, {"centre": (0, 0, 0), "semi_axes": (1, 2, 3)}, semi_axes=[(1, 1, 0)], axis=[(0, 0, 0)]),
    row(ae.specimen.Cylinder, {"centre": (0, 0, 0), "radius": 1.0}, axis=[(0, 0, 0)]),
    row(ae.specimen.Layer, {"lower": 0.0, "upper": 1.0}, normal=[(0, 0, 0)]),
    row(ae.specimen.HalfSpace, {"point": (0, 0, 0), "normal": (1, 0, 0)}, normal=[(0, 0, 0)]),
    row(ae.specimen.CoreShell, {"core": ae.specimen.Sphere((0, 0, 0), 1), "thickness": 1.0}),
    row(ae.Tip.from_settings, {"settings": shell.settings}, settings=[{"apex_radius": 3}]),
    row(shell.signed_distance, {"points": np.zeros((1, 3))}),
    row(shell.deepened, {}, "by"),
    row(TaperedCap, {"apex_radius": 3.0, "shank_length": 3.0}, "apex_radius shank_length"),
    row(ae.Arrhenius, {"temperature": 50.0}, sensitivity=[0, -1.5, {"Ni": -1.0}], bonds=[ae.evaporation.PairEnergies]),
    row(ae.evaporation.Laser, {"temperature_rise": 100.0}, direction=[(0.0, 0.0), (1.0,)]),
    row(
        ae.evaporation.CoordinationTable,
        table=[{"W": {}}, {"W": 3}, {"W": {4: -1.0}}, {"W": {99: 50.0}}, {"W": {4.5: 50.0}}],
    ),
    row(
        ae.evaporation.PairEnergies,
        cohesive_energies=[{"Ni": -1.0}, {"Ni": "x"}],
        ionisation_works=[{"Ni": 0.0}],
        ordering=[{"Al": 0.1}, {"Al-Cu": 99.0}, {3: 0.1}],
    ),
    row(
        ae.maps.ring_statistics,
        {"map": grid, "projection": ae.detection.Projection(10.0, centre=(10.0, 10.0))},
        pole=[(0, 0, 0)],
        rings=[[(1.0,)], [(5.0, 2.0)], [(0.0, 99.0)], [(NAN, 3.0)]],
        fold=[0, 7],
        sectors=[0, 10**6],
    ),
    row(
        ae.maps.folded,
        {
            "map": grid,
            "projection": ae.detection.Projection(30.0, centre=(10.0, 10.0)),
            "pole": (0.0, 0.0, 1.0),
            "symmetry": "2mm",
            "toward": (1.0, 0.0, 0.0),
        },
        "reach smoothing",
        pole=[(0, 0, 0)],
        toward=[(0, 0, 0), (0.0, 0.0, 2.0)],
        reach=[91.0, 1e-9],
        smoothing=[0.1, 1e9],
    ),
    row(
        ae.maps.trace_line,
        {"map": grid, "ends": (5.0, 5.0, 15.0, 15.0), "width": 5.0},
        "width",
        ends=[(0.0, 0.0), (1.0, 1.0, 1.0, 1.0), (NAN, 0.0, 1.0, 1.0)],
    ),
    row(ae.maps.line_amplitude, {"ring": azimuths, "measured": azimuths}),
    row(ae.spectra.charge_history, {"charges": [1, 2, 2], "element": "Ni"}, sections=[0], least=[0]),
    row(smoothed_history, {"values": [1.0, 2.0]}, points=[0]),
    row(ae.spectra.charge_state_ratio_map, {"element": "Ni"}),
    row(ae.spectra.charge_state_ratio_history, {"element": "Ni"}),
    row(ae.Instrument, dead_time=[-0.1], dead_zone=[-0.1], resolution=[-0.1], quantisation=[(0.0, 1.0), (1.0, -1.0)]),
    row(ae.Instrument.preset, {"name": "straight, 100 mm"}, "efficiency", efficiency=[1.1]),
    row(ae.Instrument().record),
    row(ae.Instrument().hits, {"hits": ae.Hits(**HITS, time_of_flight=[1.0, 2.0], pulse_id=[0, 1])}, "distance"),
    row(ae.Extremal, bonds=[ae.evaporation.PairEnergies]),
    row(
        ae.measures.interface_profile,
        {"distances": np.linspace(-0.9, 0.9, 60), "chosen": np.arange(60) % 3 == 0},
        "reach bin_width",
        distances=[[NAN, 1.0, 2.0, 3.0]],
    ),
    row(
        ae.measures.segregation_profile,
        {"distances": np.linspace(-0.9, 0.9, 60), "chosen": np.arange(60) % 3 == 0},
        "reach bin_width",
        distances=[[NAN, 1.0, 2.0, 3.0]],
    ),
    row(ae.ResponseSettings, {}, "height energy_limit bound", height=[0.0, 2.0]),
    row(
        ae.simulation.Design,
        {"degrees": (1, 0), "rings": ((0.0, 1), (1.0, 5)), "number": 8},
        degrees=[(1,), (1, 2), (13, 0), (1.5, 0), 3],
        number=[3, 10**9],
        rings=[[1], [(1.0,)], [(NAN, 5)], [(1.0, 0)], [(1.0, 10**9)], [(1.0, 2)], [("a", 1)]],
    ),
    row(ae.TruncatedNormal, {"mean": 0.1, "standard_deviation": 0.1}),
    row(ae.LateralVelocity, {"energy": 0.1}, energy=[-0.1, 155]),
    row(ae.RollUp, {"energy": 0.1}, energy=[-0.1, 155]),
    row(ae.Combined, {"energy": 0.1, "rollup_fraction": 0.5}),
    row(perturbation_of, perturbation=[{"name": 3}, {"name": "Rollup"}, {"name": "RollUp"}]),
    row(ae.emission.IonRandom, {"seed": 1, "ions": [1]}, ions=[[0.5], [NAN], [2**70]]),
    row(ae.emission.IonRandom(1, [1]).uniform, columns=[0]),
    row(
        Emissions,
        EMISSIONS,
        "nearest_neighbour_distance",
        normals=[[[0, 0, 2.0]], np.zeros((2, 3))],
        neighbours=[np.zeros((2, 3))],
        charge_states=[[0], [1.5], [1, 1], [2**70]],
        masses=[[0.0], [NAN], [1.0, 1.0]],
        ions=[[0.5], [1, 1], [2**70]],
        **dict.fromkeys(("targets", "charge_ratios")),
    ),
    row(
        ae.emission.Launches,
        {"positions": np.zeros((1, 3)), "velocities": np.zeros((1, 3)), "rolled": [False]},
        velocities=[np.zeros((2, 3))],
        rolled=[[1], [True, True]],
    ),
    row(tangent_frame),
    row(
        ae.Hits,
        HITS,
        x=[*COLUMN],
        y=[*COLUMN],
        time_of_flight=[*COLUMN],
        voltage=[*COLUMN],
        positions=[[1.0, 2.0], np.zeros((2, 2))],
        ion=[*WHOLE],
        site=[*WHOLE],
        pulse_id=[*WHOLE],
        multiplicity=[*WHOLE],
        pulses=[[-1, 2], [2**40, 1]],
        outcome=[[0, 7], [-1, 0], [0.5, 0]],
        extra=[{"a": 3}, {"a": object()}],
    ),
    row(hits.within_circle, {"radius": 3.0}, "radius"),
    row(hits.window, voltage=["ab", (1,), (2, 1), (NAN, 1), ("a", 1)]),
    row(hits.map, bins=[0, 10**6], extent=[(1, 2), (1, 1, 1, 1), (0, NAN, 0, 1)]),
    row(hits.map, {"bins": 4}, position_step=["always", (0, 1), (NAN, 1)], dither_seed=[1.5, -1]),
    row(hits.map, {"bins": 4}, mask=[[[True]], np.ones((4, 3), int)]),
    row(ae.DetectorMap.from_hits),
    row(
        ae.DetectorMap.from_array,
        {"values": np.ones((2, 2)), "x_edges": [0, 1, 2], "y_edges": [0, 1, 2]},
        values=[[[-1.0, 1], [1, 1]]],
        x_edges=[[0, 1], [0, 2, 1], [0, 1, 5]],
        y_edges=[[0, 1], [0, NAN, 1]],
        mask=[np.ones((2, 2), int), np.zeros((2, 2), bool)],
    ),
    row(grid.smoothed, sigma=[-1.0, 100.0]),
    row(ae.maps.radial_profile, {"hits": hits, "outer": 9.0}, bins=[0, 10**6]),
    row(ae.maps.radial_profile, {"hits": hits, "outer": 9.0}, "outer", inner=[-1.0]),
    row(ae.maps.azimuthal_profile, {"hits": hits, "inner": 1.0, "outer": 9.0}, bins=[0]),
    row(ae.maps.zone_line_profile, {"hits": hits, "rectangles": strip}, bins=[0, 10**6]),
    row(ae.maps.zone_line_profile, {"hits": hits}, rectangles=[[3]]),
    row(ae.maps.fit_zone_line, {"profile": ring}, "exponent", exponent=[1e3]),
    row(ae.maps.compare_profiles, {"first": ring, "second": ring}),
    row(ae.maps.Rectangle, {"centre": (0, 0), "angle": 0.0, "length": 9.0, "width": 9.0}, "length width"),
    row(ae.detection.Projection, {"scale": 50.0}, "scale compression"),
    row(ae.Orientation, {"material": "Ni"}, axis=[(0, 0, 0)]),
    row(ae.Orientation.from_matrix, {"material": "Ni"}, matrix=[2 * np.eye(3), -np.eye(3)]),
    row(
        ae.maps.fit_orientation,
        {"material": "Ni", "planes": [(1, 1, 1), (0, 0, 1)], "places": [(0.0, 0), (9.0, 0)]},
        "scale",
        planes=[[(0, 0, 0), (0, 0, 1)], [(0.5, 0, 0), (0, 0, 1)]],
        places=[[(0, 0)], [(0, 0), (0, 0)], [(0, 0), (NAN, 0)]],
        lines=[[3]],
    ),
    row(
        ae.Registration,
        {"rotation": 0.0, "scale": 1.0, "shift": (0.0, 0.0)},
        "scale",
        **dict.fromkeys(("score", "score_error", "overlap", "residual", "method", "ties")),
    ),
    row(ae.register, {"simulated": grid, "measured": grid}, "overlap", overlap=[2.0]),
    row(ae.register, {"simulated": grid, "measured": grid}, scales=[-1.0, 0, INF, (2.0, 1.0), (1, 2, 3)]),
    row(
        ae.maps.register_points,
        {"simulated_points": CORNERS, "measured_points": CORNERS},
        measured_points=[[(0, 0)] * 3],
    ),
    row(ae.simulation.Checkpoint, {"path": "a.h5"}, path=["a\x00b", "a.txt"], minutes=[-1.0], ions=[0]),
    row(ae.io.read_map, path=["a\x00b", "none.npz"]),
    row(ae.similarity, {"map_a": grid, "map_b": grid}, "data_range", map_b=[hits]),
    row(ae.maps.similarity_ceiling, {"hits": hits}),
    row(
        ae.spectra.Ranges,
        RANGES,
        names=["Ni", [3]],
        low=[[NAN], [1.0, 2.0], [70.0]],
        high=[[NAN], [1.0, 2.0], [1.0]],
        volume=[[1.0, 2.0]],
        colour=["red"],
        composition=["NiO", [3]],
    ),
    row(ranges.index),
    row(ranges.labels, {"hits": hits}),
    row(
        ae.reconstruct,
        {"hits": hits, "atomic_volume": 0.011, "distance": 100.0, "evaporation_field": 35.0},
        "atomic_volume distance evaporation_field field_factor compression efficiency radius detector_radius area",
        efficiency=[1.1],
        radius=["no such", [1.0, NAN, 1.0], [1.0, 0.0, 1.0]],
        detector_radius=[0.1],
        smoothing=[0],
        initial_radius=[10.0],
    ),
    row(
        ae.reconstruction.ReconstructionSettings,
        {"distance": 90.0, "atomic_volume": 0.011, "evaporation_field": 35.0},
        radius=["no such", 0.0, NAN, [1.0, NAN], [[1.0]]],
        element=[3, []],
    ),
    row(
        ae.reconstruct,
        {"hits": hits, "atomic_volume": 0.011, "distance": 9.0, "radius": "shank"}
        | {"initial_radius": 30.0, "shank_angle": 5.0},
        "initial_radius",
        shank_angle=[-1.0, 45],
        evaporation_field=[30.0],
        field_factor=None,
        smoothing=None,
    ),
    row(
        ae.reconstruction.fit_shank,
        {
            "hits": hits,
            "lens": ae.detection.LocalElectrode(40e3, 20e3, 5.0),
            "atomic_volume": 0.011,
            "distance": 100.0,
        },
    ),
    row(
        ae.detection.field_of_view,
        {
            "lens": ae.detection.LocalElectrode(40e3, 20e3, 5.0),
            "tip": ae.Tip("Ni", apex_radius=2.0),
            "detector": ae.Detector(distance=90.0, width=45.0),
        },
    ),
    row(
        ae.reconstruction.checks,
        {"reconstruction": ae.reconstruct(hits, atomic_volume=0.011, distance=100.0, radius=30.0)},
        "radius",
    ),
    row(
        ae.evaporation.conditions,
        {"composition": {"Al": 1.0}},
        composition=[{"Al": 0.5}, {"Al": NAN}],
        temperatures=[[0.0], [NAN], 1e9],
        pulse_fractions=[[0.0], [NAN], 1.5],
    ),
    row(ae.detection.Cooling, {"temperature": 50.0, "temperature_rise": 100.0, "time_constant": 2.0}),
    row(ae.studies.VisibilitySettings, {"analysis": "clusters.py:pairs"}),
    row(
        ae.Reconstruction.errors,
        {"self": ae.reconstruct(hits, atomic_volume=0.011, distance=100.0, radius=30.0), "truth": np.eye(3)},
        self=None,
        truth=[np.zeros((2, 3))],
        fit=["shift", ["scale"], [3]],
    ),
    row(
        ae.reconstruction.compression_from_poles,
        {"crystal_angles": [54.7, 35.3], "observed_angles": [35.0, 22.0]},
        crystal_angles=[[NAN, 1.0], [0.0, 1.0], [200.0, 1.0]],
        observed_angles=[[1.0], [NAN, 1.0], [-1.0, 1.0]],
    ),
    row(
        ae.reconstruction.find_planes,
        {"positions": np.random.default_rng(0).random((100, 3)), "widest": 0.0},
        positions=[np.zeros((3, 2)), None],
        at=[[1.0], "centre"],
        radius=[0, -1.0, NAN, "1"],
        widest=[-1, 61, NAN],
        reach=[0, NAN, "1"],
    ),
    row(
        ae.reconstruction.distribution_map,
        {"positions": np.indices((3, 3, 3)).reshape(3, -1).T * 0.2},
        "lateral reach radius",
        positions=[np.zeros((1, 3)), np.zeros((4, 2))],
        axis=[-1, 0.5, (0, 0, 0), (1.0, NAN, 0), (1, 1)],
        max_pairs=[0],
    ),
    row(ae.emission.ChargeRatio, {"threshold": 0.9}),
    row(ae.emission.Migration, {"cohesive_energy": 4.44, "field": 35.0}),
    row(
        ae.emission.Mixture,
        {"perturbations": (ae.RollUp(0.2), ae.Unperturbed())},
        perturbations=[(), (ae.RollUp(0.2),), (ae.RollUp(0.2), "x")],
        weights=[(1.0,), (1.0, -1.0), (1.0, NAN)],
    ),
    row(ae.simulation.ImagingGas, {"name": "Xe", "ionisation_energy": 12.13, "field": 15.0}, "ionisation_energy field"),
    row(
        ae.maps.pole_profile,
        {"map": grid, "projection": ae.detection.Projection(10.0, centre=(10.0, 10.0))},
        radii=[[1.0], [2.0, 1.0], [NAN, 1.0]],
    ),
    row(
        ae.maps.pole_line_profile,
        {
            "map": grid,
            "projection": ae.detection.Projection(10.0, centre=(10.0, 10.0)),
            "pole": (0, 0, 1),
            "toward": (1, 0, 1),
        },
        pole=[(0, 0, 0)],
        bins=[0],
    ),
    row(effective_ions),
    row(ae.io.read_grid, path=["a\x00b", "none.csv"]),
    row(ae.read_tip, path=["a\x00b", "none.lmp"]),
    row(
        ae.maps.score_surface,
        {"simulated": grid, "measured": grid, "scales": (0.9, 1.1)},
        scales=[(0.0, 1.0), (2.0, 1.0)],
        rotations=[(2.0, 1.0)],
    ),
    row(ae.maps.register_distortion, {"simulated": grid, "measured": grid}),
    row(Distortion, {"degree": 1, "centre": (0.0, 0.0), "radius": 1.0, "coefficients": (1.0,)}),
    row(ae.fit.EnergyGrid, means=[[NAN], [0.0], [2.0, 1.0]]),
    row(ae.load, path=["a\x00b", "none.h5"]),
    row(ae.read, path=["a\x00b", "none.epos"]),
    row(ae.io.read_ranges, path=["a\x00b", "none.rrng"]),
    row(ae.write, {"path": "a.epos", "hits": hits}, path=["a\x00b", "a.txt", "a.apt"]),
    row(ae.write, {"path": "a.epos", "hits": hits}, format=[b".pos", ".txt"]),
    row(
        ae.emission.charge_state_ratio,
        {"element": "Ni", "charge": 1, "field": 35.0},
        charge=[0, 1.5, 9],
        field=[[1.0, NAN], [[1.0], [1.0, 2.0]]],
    ),
    row(ae.emission.field_of_ratio, {"element": "Ni", "charge": 1, "ratio": 0.1}, charge=[0, 1.5, 9], ratio=[-1.0]),
    row(
        tunnel_factor,
        {"field": 44.0, "ionisation_energy": 24.6},
        "ionisation_energy",
        field=[0, -1.0, [1.0, 0.0], 10**400],
    ),
    row(plane_normals, {"material": nickel, "planes": [(1, 1, 1)]}, name=None),
    row(direction_normals, {"material": nickel, "directions": [(1, 1, 1)]}, name=None),
    row(ae.maps.poles, {"material": nickel}),
    row(ae.maps.zones, {"material": nickel}),
    row(point_group, {"structure": "fcc"}),
    row(pole_symmetry, {"material": nickel, "direction": (1, 1, 1)}),
    row(symmetry_about_axis, {"material": nickel, "orientation": np.eye(3)}),
    row(ae.specimen.atom_density, {"structure": "hcp", "a": 0.35}, "a c"),
    row(nearest_neighbour_distance, {"structure": "hcp", "a": 0.35}, "a c"),
    row(ae.specimen.rotation_to_axis, {"material": nickel, "axis": (1, 1, 1)}),
    row(
        ae.detection.mass_to_charge,
        {"voltage": 5e3, "time_of_flight": 600.0, "x": 0.0, "y": 0.0, "distance": 90.0},
        "distance",
    ),
    row(
        ae.detection.LocalElectrode,
        {"distance": 40e3, "aperture": 20e3, "shank_angle": 5.0},
        profile=[[1.0], [(0.0, 20.0)], [(0.0, 20.0), (0.0, 30.0)], [(0.0, 20.0), (50.0, 10.0)]],
    ),
    row(RealUnits, {"field_reference": "cap", "operating_field": 35.0}),
    row(CostEstimate, {"ions": 10}),
]
NEEDS_A_RUN = [
    row(ae.Simulation, {"tip": shell, "n_threads": 1}, "voltage", voltage=[1e9], n_threads=[0, 10**6]),
    row(
        "simulation.run",
        {"n_ions": 1, "progress": False},
        n_ions=[0],
        emissions=[[3], ae.Unperturbed()],
        batch_size=[0],
    ),
    row(ae.evaporation.Emitter, {"tip": shell}, "voltage"),
    row("emitter.field_at", {"points": [[0.0, 0, 9]]}, opening_angle=[-1.0]),
    row("emitter.potential_at", {"points": [[0.0, 0, 9]]}, opening_angle=[-1.0]),
    row("emitter.relax", {}, "tolerance"),
    row("emitter.evaporate", max_events=[0]),
    row("run.hits", {"perturbation": ae.Unperturbed()}),
    row("simulation.run", {"n_ions": 1, "progress": False}, checkpoint=["a\x00b", "a.txt"]),
    row(
        "run.at_evaporation_field",
        {},
        "operating_field field_factor",
        flight_charges=[0, -1, 1.5, {"Al": 1}, {"Ni": 0}],
        smoothing=[0],
    ),
    row("run.on_detector"),
    row("real.record", {"instrument": ae.Instrument()}),
    row(ae.simulation.fit_caps, {"windows": 1}),
    row(ae.reconstruction.origin_table),
    row(ae.fit.fit_tips, {"measured": hits}),
    row(
        ae.fit.fit_radius,
        {
            "measured": grid,
            "projection": ae.detection.Projection(10.0),
            "perturbations": ae.Unperturbed(),
            "plane": (1, 1, 1),
        },
    ),
    row(ae.simulation.field_ion_image),
    row(target_shares, {"sharpness": 0.1}),
    row(ae.simulation.image_compression),
    row(evaporation_fields),
    row(evaporation_voltages),
    row(ae.reconstruction.run_constants),
    row(ae.simulation.lateral_tracks, {"ions": [0], "energies": [0.1]}),
    row(ae.simulation.rollup_tracks, {"ions": [0], "energies": [0.1]}),
    row(ae.fit_energies, {"measured": hits}),
    row("tracks", {"energies": [0.1]}, ions=[[0.5], [-1], [99], [2**70]]),
    row("tracks", {"ions": [0]}, energies=[[NAN], [-1.0], [99.0]]),
    row("fit_energies"),
    row("run.save", path=["a\x00b", "no such folder/a.h5"]),
]


def of_annotation(parameter):
    """Values of another type than a parameter is declared to have."""
    kinds = str(getattr(parameter.annotation, "__name__", parameter.annotation))
    values = [object()]
    if "None" not in kinds and parameter.default in (parameter.empty, False):
        values.append(None)
    if re.fullmatch(r"float( \| None)?", kinds):
        values += [True, [1.0], NAN, -INF, 10**400]
        values += [INF] if parameter.name != "ions" else []  # infinite: a map without noise
    if re.fullmatch(r"int( \| None)?", kinds):
        values += [True, 1.5, -1, NAN, 2**80]
    if re.fullmatch(r"bool( \| None)?", kinds):
        values += ["no", 1]
    if re.fullmatch(r"str( \| None)?", kinds):
        values += [3, b"x"]
    return values


def of_declaration(setting, default):
    """Values of another type than a field of settings is declared to have, or outside its bounds."""
    values = {
        "float": [object(), True, NAN, INF, -INF, 10**400],
        "int": [object(), True, 1.5, 2**80],
        "bool": ["no", 1],
    }
    values = values.get(setting.kind, [])
    values = [object(), 3, "", "no such"] if re.fullmatch(r"\{.*\}", setting.kind) else values
    steps = {">": 0, ">=": -1, "from": -1, "<": 0, "<=": 1, "to": 1}
    for sign, bound in re.findall(r"(>=?|<=?|from|to) (\S+)", setting.bounds):
        beyond = float(bound) + steps[sign] * max(1.0, abs(float(bound)))
        values = [*values, beyond if setting.kind == "float" else round(beyond)] if values else []
    return [*values, None] if values and default is not None else values


def wrong_values(function, good, positive, special):
    """Wrong values by argument: by the declared type, those that must be greater than zero, and by their meaning."""
    of_settings = declared(function) if isinstance(function, type) else {}
    parameters = inspect.signature(function).parameters
    wrong = {}
    for name, parameter in parameters.items():
        if name in of_settings:
            wrong[name] = of_declaration(of_settings[name], parameter.default)
        elif parameter.kind not in (parameter.VAR_POSITIONAL, parameter.VAR_KEYWORD):
            wrong[name] = of_annotation(parameter)
    for name in positive.split():
        wrong[name] = [*wrong.get(name, [object(), True, NAN]), 0, -1.5]
    for name, values in special.items():
        wrong[name] = values and [*wrong.get(name, ()), *values]
    kinds = inspect.Parameter
    missing = {
        name
        for name, parameter in parameters.items()
        if parameter.default is kinds.empty and parameter.kind not in (kinds.VAR_POSITIONAL, kinds.VAR_KEYWORD)
    } - set(good)
    return {name: values for name, values in wrong.items() if values and name in (missing or wrong)}


SPACES = [thing for thing in (getattr(ae, name) for name in ae.__all__) if inspect.ismodule(thing)]
PUBLIC = {name: getattr(place, name) for place in (ae, *SPACES) for name in getattr(place, "__all__", ())}


TRIED = {case[0] for case in CASES}
SETTINGS = [cls for cls in PUBLIC.values() if isinstance(cls, type) and declared(cls) and cls is not ae.Registration]
CASES += [row(cls) for cls in SETTINGS if cls not in TRIED]


def check_all(function, good, positive, special):
    for name, values in wrong_values(function, good, positive, special).items():
        for value in values:
            refused(lambda value, name=name: function(**(good | {name: value})), value, name)
    assert not os.listdir()


def ids(cases):
    names = [function if isinstance(function, str) else function.__qualname__ for function, *_ in cases]
    return [f"{name}-{number}" for number, name in enumerate(names)]


@pytest.mark.parametrize("case", CASES, ids=ids(CASES))
def test_bad_arguments_are_refused_by_name(tmp_path, monkeypatch, case):
    monkeypatch.chdir(tmp_path)
    check_all(*case)


@pytest.mark.parametrize("case", NEEDS_A_RUN, ids=ids(NEEDS_A_RUN))
def test_bad_arguments_of_a_simulation_are_refused_by_name(tmp_path, monkeypatch, ready, case):
    monkeypatch.chdir(tmp_path)
    function, *rest = case
    if isinstance(function, str):
        function = attrgetter(function)(SimpleNamespace(**ready))
    check_all(function, *rest)


# names of these are tried in the tests of their packages
OTHER_PACKAGES = (ae.plot, ae.studies)
# made by the package
MADE = {"FileError", "TruncatedFile", "Outcome", "StopReason", "RunInterrupted", "RunNotSaved", "Run", "EmitterState"}
MADE |= {"Reconstruction", "Study", "ZoneLine", "History", "CapHistory", "Ring", "RadiusFit", "TipFit", "Distortion"}
MADE |= {"DistortionGrid", "FittedOrientation", "Similarity", "Batch", "Lens", "Spectrum"}
# for extensions, which call them with arrays of the package
ARRAYS = {"charge_probabilities", "draw_isotopes", "field_of_counts", "ion_charges"}
ARRAYS |= {"smoothed_history", "charge_history"}
ARRAYS |= {"launch_tangentially", "ratio_of_counts", "rollup_direction", "lattice_sites_in", "BondField"}
ARRAYS |= {"Detection", "charge_residuals", "surface_after", "roll_ups"}


def is_result(thing):
    """Whether a class holds results, or is an interface."""
    if not isinstance(thing, type) or declared(thing):
        return False
    return is_dataclass(thing) or hasattr(thing, "_fields") or getattr(thing, "_is_protocol", False)


def test_every_public_name_with_arguments_is_in_the_table():
    """A new public class or function is in the table above, or it is said here why not."""
    tried = {getattr(function, "__self__", function) for function, *_ in (*CASES, *NEEDS_A_RUN)}
    tried |= {ae.Run, ae.Simulation}
    taken = {*MADE, *ARRAYS, "Unperturbed", "Union"}  # no arguments; positional arguments only, in test_regions
    taken |= {"chunks", "precipitate_errors", "likeness"}  # in test_chunks, test_precipitate, test_verdict
    taken |= {"write_nodes", "write_types", "describe"}  # in test_tapsim_nodes, test_main
    taken |= {"index", "indexing", "MasterPattern", "master_patterns", "master_pattern"}  # in tests/maps
    taken |= {
        "Measurement",
        "constants_of",
        "constants_of_crystal",
        "settings_of",
        "density_gains",
    }  # in tests/fit, tests/maps
    taken |= {"PointCloud", "CompositionField", "TriangleMesh", "ConvexHull", "label_clusters"}  # in tests/measures
    taken |= {"compare_with_truth", "corrected", "truth_comparison"}  # in tests/reconstruction
    taken |= {"assumptions", "local_scatter", "position_covariances", "check_specimen", "phase_sizes"}
    taken |= {"dissociation_line", "load_dataset"}  # in test_correlation, test_dataset
    taken |= {"choose_separation", "nearest_neighbours", "radial_distribution", "short_range_order"}
    taken |= {"interfacial_excess", "ladder_diagram", "read_mesh", "clusters", "composition_profile"}  # and tests/io
    taken |= {"simulate", "compare", "twin", "spectrum", "write_rrng"}  # in tests/studies, tests/cli, tests/detection
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


@pytest.mark.slow
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
    with pytest.raises(ValueError, match=r"n_threads=64.*0\.001 GB"):
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
        (ae.simulation.FlightSettings(), ["FlightSettings", "tolerance=", "max_steps=500"]),
        (ae.ResponseSettings(), ["energy_limit=1.5", "bound=0.2", "Design((5, 4, 2, 1, 0)"]),
    ]
    for thing, words in told:
        assert all(word in repr(thing) for word in words), repr(thing)
        assert "\n" not in repr(thing) and len(repr(thing)) < 260 and "0x" not in repr(thing)
    assert repr(run.responses) == "<Responses: 12 ions, 46 coefficients from the site, 56 rolled up>"
    assert "evaporated atoms" in repr(emitter.evaporate(1))


def test_numbers_of_numpy_look_like_those_of_python():
    one, two = np.float64(3), np.int32(1)
    assert short_text(one) == "3.0" and short_text((one, [two])) == "(3.0, [1])"
    assert short_text({"a": np.bool_(True)}) == "{'a': True}"
    with pytest.raises(ValueError, match=r"got \(3\.0, 1\)$"):
        Hits(x=[1.0], y=[2.0]).window(x=(one, two))
