"""Examples from a run: what an instrument records for each emission, and the truth."""

import json
from dataclasses import replace
from typing import Any

import numpy as np

from apt_evap._common.codec import for_json, to_plain
from apt_evap._common.types import Floats
from apt_evap.detection.hits import Hits
from apt_evap.detection.instrument import Instrument
from apt_evap.maps.crystallography.directions import poles, zones
from apt_evap.maps.crystallography.orientation import Orientation
from apt_evap.simulation.apex import image_compression
from apt_evap.simulation.config.perturbation_text import read_perturbation
from apt_evap.simulation.run import Run
from apt_evap.specimen.lattice import check_axis
from apt_evap.studies.dataset.dataset_settings import DatasetSettings, read_instrument
from apt_evap.studies.dataset.fields import LINE_POINTS, TEXT, Field, chosen_tables
from apt_evap.studies.sweep.sampling import drawn, seed_of
from apt_evap.studies.sweep.study_file import Point

Rows = dict[str, Any]
"""Columns of a table by name: arrays, and lists of texts."""


def examples_of(run: Run, point: Point, settings: DatasetSettings, split: str) -> list[dict[str, Rows]]:
    """Examples of a run: for each emission the columns of all tables."""
    real = run.in_real_units()
    orientation = Orientation.known(run.settings["tip"])
    projection = _projection(real) if orientation is not None else None
    about = {
        "run": point.key,
        "split": split,
        "evaporated": len(run),
        "elements": json.dumps(run.elements),
        "phases": json.dumps(run.phase_names),
        "compression": np.nan if projection is None else projection.compression,
        "settings": _json({name: value for name, value in point.document.items() if name != "output"}),
        "fingerprint": run.fingerprint(),
        **_crystal(orientation),
    }
    examples = []
    for number, emission in enumerate(settings.plan):
        seed = seed_of(point.key, number)
        random = np.random.default_rng(seed)
        perturbation = read_perturbation(drawn(emission, random, "emissions"))
        instrument = read_instrument(drawn(settings.instrument, random, "instrument"))
        hits = replace(real, seed=seed).record(instrument, perturbation, seed=seed)
        columns = _ions(hits)
        tables = {"ions": {name: columns[name] for name in settings.fields if name in columns}}
        if orientation is not None and "poles" in settings.fields:
            tables["poles"] = _poles(orientation, settings.families, projection, real, instrument)
        if orientation is not None and "zone_lines" in settings.fields:
            tables["zone_lines"] = _zone_lines(orientation, projection, real, instrument)
        if "cap" in settings.fields:
            tables["cap"] = {"number": run.cap.ions, "radius": run.cap.radii, "apex": run.cap.apexes}
        of_example = {
            "name": f"{point.key}-{number}",
            "first_ion": 0,
            "ions": len(hits),
            "emission": _json(to_plain(perturbation)),
            "instrument": _json(to_plain(instrument)),
            "seed": seed,
        }
        tables["examples"] = {name: [value] for name, value in (about | of_example).items()}
        examples.append(tables)
    return examples


def _json(thing):
    return json.dumps(for_json(thing), sort_keys=True)


def _crystal(orientation):
    if orientation is None:
        unknown = {"axis": np.full(3, np.nan), "orientation": np.full((3, 3), np.nan)}
        return unknown | {"material": "", "structure": "", "lattice_constant": np.nan}
    material = orientation.material
    return {
        "material": material.name,
        "structure": material.structure,
        "lattice_constant": material.a,
        "axis": np.array(check_axis(material.structure, orientation.axis), float),
        "orientation": orientation.matrix,
    }


def _ions(hits: Hits) -> Rows:
    """Columns of the ions by the names of the fields."""
    n = len(hits)
    return {
        **{name: getattr(hits, name) for name in ("x", "y", "time_of_flight", "mass_to_charge", "voltage")},
        "pulse_voltage": np.zeros(n) if hits.pulse_voltage is None else hits.pulse_voltage,
        "pulse": hits.pulse_id,
        "multiplicity": hits.multiplicity,
        "site": hits.positions,
        "species": hits.extra["species"],
        "phase": hits.extra.get("phase", np.zeros(n)),
        "charge": hits.extra["charge_state"],
        "number": hits.ion,
    }


def _projection(real):
    """Projection of directions onto a plane detector, None for a run with too few ions."""
    try:
        return image_compression(real.on_detector(replace(real.detector, projection="plane"))).projection
    except ValueError:
        return None


def _places(directions: Floats, projection: Any, real: Run, instrument: Instrument) -> Floats:
    """Positions of directions in the specimen on the detector of an instrument [mm]; NaN outside."""
    if projection is None:
        return np.full((len(directions), 2), np.nan)
    return instrument.places(projection.places(directions) * (instrument.distance / real.detector.distance))


def _poles(orientation, families, projection, real, instrument):
    crystal_poles = poles(orientation, families)
    normals = orientation.directions(crystal_poles.normals)
    places = _places(normals, projection, real, instrument)
    with np.errstate(invalid="ignore"):
        visible = np.hypot(*places.T) <= instrument.field_of_view / 2
    return {
        "indices": crystal_poles.planes[:, [0, 1, -1]],
        "normal": normals,
        "spacing": crystal_poles.spacings,
        "x": places[:, 0],
        "y": places[:, 1],
        "visible": visible,
    }


def _zone_lines(orientation, projection, real, instrument):
    crystal_zones = zones(orientation)
    directions = orientation.directions(crystal_zones.directions)
    angles = np.radians(np.linspace(-90.0, 90.0, LINE_POINTS))[:, None]
    lines = []
    for axis in directions:
        top = np.array([0.0, 0.0, 1.0]) - axis[2] * axis
        height = np.linalg.norm(top)
        if height < 1e-6:  # the line is the horizon
            lines.append(np.full((LINE_POINTS, 2), np.nan))
            continue
        top = top / height
        circle = np.cos(angles) * top + np.sin(angles) * np.cross(axis, top)
        places = _places(circle, projection, real, instrument)
        with np.errstate(invalid="ignore"):
            places[~(np.hypot(*places.T) <= instrument.field_of_view / 2)] = np.nan
        lines.append(places)
    axes = (
        crystal_zones.axes
        if crystal_zones.axes.shape[1] == 3
        else crystal_zones.axes[:, [0, 1, 3]] - crystal_zones.axes[:, [2, 2, 2]] * [1, 1, 0]
    )
    x, y = np.moveaxis(np.array(lines), 2, 0)
    return {"indices": axes, "direction": directions, "x": x, "y": y}


def joined(examples: list[dict[str, Rows]], settings: DatasetSettings) -> dict[str, Rows]:
    """Tables of several examples, with the index of the example in each row."""
    tables: dict[str, Rows] = {}
    for name, fields in chosen_tables(settings.fields).items():
        parts = [example.get(name, {}) for example in examples]
        lengths = [len(next(iter(part.values()))) if part else 0 for part in parts]
        if name == "ions":  # also if no column of the ions is chosen
            lengths = [example["examples"]["ions"][0] for example in examples]
        columns = {"example": np.repeat(np.arange(len(examples)), lengths)}
        tables[name] = {
            field.name: columns[field.name] if field.name in columns else _column(field, parts) for field in fields
        }
        tables[name] = {field.name: typed(tables[name][field.name], field) for field in fields}
    counts = np.array(tables["examples"]["ions"])
    tables["examples"]["first_ion"] = np.cumsum(counts) - counts
    return tables


def _column(field: Field, parts: list[Rows]) -> Any:
    present = [part[field.name] for part in parts if part]
    if field.dtype == TEXT:
        return [text for part in present for text in part]
    return np.concatenate([np.reshape(part, (-1, *field.row)) for part in present]) if present else np.empty(0)


def typed(values: Any, field: Field) -> Any:
    """Values of a field in its type; a list of texts as it is."""
    return list(values) if field.dtype == TEXT else np.reshape(np.asarray(values, field.dtype), (-1, *field.row))
