"""Charge states by place: the ratio of two charges towards two families of poles and elsewhere.

    python charge_states.py W --ions W_tap.raw RUNS/W_160_others_1_responses.h5 RUNS/W_160_Robin_1.h5
    python charge_states.py Ni RUNS/Ni_160_others_1_responses.h5 --most 40000

An ion can lose another electron on the first nanometre of its flight. The events of a run are repeated, and the field
just after each event is taken on the way of its ion, at some heights above its site and its start. Kingham's curves
turn the fields into ratios. One factor for all fields makes the ratio elsewhere the measured one, or the one assumed
in `CHARGES`; the two others are predictions. The fields that the law of evaporation saw are printed, too.
"""

import argparse
import warnings
from pathlib import Path

import numpy as np
from judge import METALS, measured_of, projection_of
from runs import RULES
from scipy.optimize import brentq

import apt_evap as ae
from apt_evap._common.codec import from_plain

HEIGHTS = (0.0, 0.2, 0.4, 0.7, 1.0)  # nm above the start
NEAR, FIRST = 1.7, 3.0  # degrees: half the width of a strip, and where it begins
CHARGES = {  # lower charge, assumed ratio elsewhere, and the two families of poles
    "W": (3, 0.003, ((0, 0, 2), (2, 2, 2))),
    "Ni": (1, 1.0, ((0, 0, 2), (0, 2, 2))),
    "Al": (1, 0.01, ((0, 0, 2), (0, 2, 2))),
}


def regions(directions, orientation, metal, near=NEAR, between=None):
    """Masks of directions: in the strips from the pole towards the poles of two families, and of the rest.

    Strips have half the width `near`, between two angles from the pole [degrees].
    """
    pole = np.asarray(orientation.nearest_pole(METALS[metal].pole).direction)
    angle = np.degrees(np.arccos(np.clip(directions @ pole, -1, 1)))
    inner, outer = between or (FIRST, METALS[metal].reach)
    inside = (angle > inner) & (angle < outer)
    found = ae.maps.poles(orientation.material, 10)
    strips = []
    for family in CHARGES[metal][2]:
        member = (np.sort(np.abs(found.planes), axis=1) == family).all(axis=1)
        normals = orientation.directions(found.normals[member])
        cosines = normals @ pole
        others = cosines < 0.999
        strip = np.zeros(len(directions), bool)
        for normal in normals[others & (cosines > cosines[others].max() - 1e-6)]:
            along = normal - (normal @ pole) * pole
            along = along / np.linalg.norm(along)
            beside = np.degrees(np.arcsin(np.clip(directions @ np.cross(pole, along), -1, 1)))
            strip |= inside & (np.abs(beside) < near) & (directions @ along > 0)
        strips.append(strip)
    return *strips, inside & ~strips[0] & ~strips[1]


def names_of(metal):
    """Names of the regions."""
    return [f"towards {{{''.join(str(each) for each in family)}}}" for family in CHARGES[metal][2]] + ["elsewhere"]


def measured(path):
    """Print the measured ratios; returns that elsewhere."""
    ions = ae.read(path)
    length = np.hypot(305.0, np.hypot(ions.x, ions.y)) * ae.units.NM_PER_MM
    time = ions.time_of_flight - 38.5  # ns: W3+ is at 60.65 to 61.98 Da at the rim, and 0.7 Da higher on the axis
    ratio = ions.voltage * (ae.units.SPEED * time / length) ** 2
    three, four = (ratio > 59.0) & (ratio < 63.4), (ratio > 44.8) & (ratio < 47.2)
    beside = ((ratio > 42.2) & (ratio < 44.6)) | ((ratio > 47.4) & (ratio < 49.8))
    _, orientation, projection = measured_of("W", ions[three])
    directions = projection.directions(np.column_stack([ions.x, ions.y]))

    def counted(region):
        n, peak, ground = (np.count_nonzero(region & each) for each in (three, four, beside))
        return (peak - ground / 2) / n, np.sqrt(peak + ground / 4) / n

    found = [counted(region) for region in regions(directions, orientation, "W")]
    for name, (part, error) in zip(names_of("W"), found, strict=True):
        print(f"measured {name}: {part:.4f} +- {error:.4f}")
    for near in (1.0, NEAR, 2.5):  # the ratio depends on the region
        for between in ((3.0, 10.0), (3.0, 12.0), (3.0, 15.5), (10.0, 15.5)):
            part, error = counted(regions(directions, orientation, "W", near, between)[0])
            print(f"measured {names_of('W')[0]}, within {near:g} degrees, {between[0]:g} to {between[1]:g}: "
                  f"{part:.4f} +- {error:.4f}")  # fmt: skip
    return found[-1][0]


def fields_on_the_way(run, skip, starts, chosen):
    """Fields at `HEIGHTS` above places of chosen ions [V/nm, at the voltage of the run], shape (n, places, heights).

    `starts` has the shape (ions, places, 3); the events of the run are repeated.
    """
    rule = RULES[run.settings["rule"].get("law_field", "Robin")]
    specimen = ae.Tip.from_settings(run.settings["tip"])
    law = from_plain(run.settings["law"], ae.Extremal, what="the law")
    emitter = ae.evaporation.Emitter(specimen, run.voltage, law, n_threads=1, rule=rule)
    emissions, found = run.emissions, np.full((len(run), starts.shape[1], len(HEIGHTS)), np.nan)
    for _ in emitter.advance(skip):
        pass
    row = 0
    for event in emitter.advance(len(run), batch_size=1):
        if len(event) == 0:
            continue
        if row % 10_000 == 0:
            np.testing.assert_allclose(emitter.tip.positions[event.site[0]], emissions.positions[row], atol=1e-9)
        if chosen[row]:
            points = starts[row][:, None] + np.outer(HEIGHTS, event.normals[0])
            fields = emitter.field_at(points.reshape(-1, 3))
            found[row] = np.linalg.norm(fields, axis=1).reshape(found[row].shape)
        row += 1
        if not chosen[row:].any():
            break
    return found[chosen]


def simulated(metal, path, skip, most, elsewhere):
    """Print the ratios of a run at every height."""
    run = ae.load(path)
    scale = float(np.median(run.at_evaporation_field().energy_scales))
    emission = run.perturbations[-1] if run.perturbations else ae.RollUp.of_metal(metal, energy_scale=scale)
    hits, projection = run.hits(emission), projection_of(run)
    orientation = ae.Orientation.from_settings(run.settings["tip"])
    directions = projection.directions(np.where(hits.detected[:, None], np.column_stack([hits.x, hits.y]), 0.0))
    masks = [hits.detected & each for each in regions(directions, orientation, metal)]
    chosen = np.logical_or.reduce(masks)
    chosen[most:] = False
    masks = [each & chosen for each in masks]
    print(f"{path.name}: {[int(each.sum()) for each in masks]} ions")
    seen = [run.fields[each].mean() for each in masks]
    print(f"{path.name}: fields that the law saw over those elsewhere {seen[0] / seen[2]:.3f} {seen[1] / seen[2]:.3f}")
    random = ae.emission.IonRandom(run.settings["seed"], run.emissions.ions)
    starts = emission.launch(run.emissions, random).positions
    places = np.stack([run.emissions.positions, starts], axis=1)
    fields = fields_on_the_way(run, skip, places, chosen)
    limits = ae.emission.field_of_ratio(metal, CHARGES[metal][0], np.array([1e-6, 50.0]))
    for name, at in (("site", 0), ("start", 1)):
        for height, values in zip(HEIGHTS, fields[:, at].T, strict=True):
            parts = [values[each[chosen]] for each in masks]
            ends = [np.log(field / np.median(values)) for field in limits]
            factor = np.exp(brentq(lambda log, rest=parts[2]: ratio_of(metal, np.exp(log) * rest) - elsewhere, *ends))
            ratios = " ".join(f"{ratio_of(metal, factor * each):.4f}" for each in parts)
            relative = " ".join(f"{np.mean(each) / np.mean(parts[2]):.3f}" for each in parts[:2])
            print(f"{path.name} {height:.1f} nm above the {name}: {ratios}; mean fields {relative}", flush=True)


def ratio_of(metal, fields):
    """Ratio of the numbers of the two charges by Kingham's curves, for the fields of many ions [V/nm]."""
    ratio = np.minimum(ae.emission.charge_state_ratio(metal, CHARGES[metal][0], fields), 1e6)
    share = np.mean(ratio / (1 + ratio))
    return share / (1 - share)


def main():
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("metal", choices=CHARGES)
    parser.add_argument("--ions", help="measured, with all charge states; tungsten only")
    parser.add_argument("runs", nargs="+", type=Path)
    parser.add_argument("--skip", type=int, default=110_000, help="that of runs.py")
    parser.add_argument("--most", type=int, default=100_000, help="ions of a run, arrived or not")
    options = parser.parse_args()
    warnings.simplefilter("ignore", ae.warnings.ResponseWarning)
    elsewhere = measured(options.ions) if options.ions else CHARGES[options.metal][1]
    for path in options.runs:
        simulated(options.metal, path, options.skip, options.most, elsewhere)


if __name__ == "__main__":
    main()
