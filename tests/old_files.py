"""Runs as earlier versions saved them: format 2, and chunks with checksums of HDF5 and older names of settings."""

import json

import h5py
import numpy as np


def old_settings(settings):
    """Settings under the names that they had."""
    old = json.loads(json.dumps(settings))
    old["flights"]["most_steps"] = old["flights"].pop("max_steps")
    old["watch"]["share_bound"] = old["watch"].pop("fraction_bound")
    assert old["rule"] == {"name": "Robin", "tolerance": 1e-5, "window": 8}
    old["rule"] = "Robin"
    assert old["law"] == {"name": "Extremal", "bonds": None}
    old["law"] = {"name": "Extremal", "repr": "Extremal()"}
    assert old.pop("control") is old.pop("pulse_length") is None
    return old


NEW_IONS, OLD_IONS = "entry1/atom_probe/hit_spatial_filtering/evaporation_id", "entry1/atom_probe/evaporation_id"
ONLY_NEW = (
    "entry1/definition",
    "entry1/start_time",
    "entry1/operation_mode",
    "entry1/specimen",
    "entry1/laboratory_reference_frame",
    "entry1/atom_probe/hit_spatial_filtering",
)


def make_old(path, rows=4096):
    """Rewrite the file of a run, or of a state, as an earlier version would have written it."""
    items = {}

    def note(name, item):
        if name == NEW_IONS:
            name = OLD_IONS
        elif name.startswith(ONLY_NEW) or name.rpartition("/")[2] in ("program1", "program", "config"):
            return
        items[name] = (item[()] if isinstance(item, h5py.Dataset) else None, list(texts_and_numbers(item)))

    with h5py.File(path, "r") as file:
        note("/", file)
        file.visititems(note)
    with h5py.File(path, "w") as file:
        for name, (values, attributes) in items.items():
            if values is None:
                item = file.require_group(name)
            else:
                chunks = (min(len(values), rows), *values.shape[1:]) if values.size else None
                item = file.create_dataset(name, data=values, chunks=chunks, fletcher32=chunks is not None)
            for key, value in attributes:
                if key == "NX_class" and name != "entry1":
                    continue
                if key == "format":
                    value = b"apt_evap run 2"
                if key == "settings":
                    value = json.dumps(old_settings(json.loads(value))).encode()
                if key == "provenance":
                    value = json.dumps({k: v for k, v in json.loads(value).items() if k != "systems"}).encode()
                if isinstance(value, bytes):
                    item.attrs.create(key, value, dtype=h5py.string_dtype("utf-8", max(1, len(value))))
                else:
                    item.attrs[key] = value


def texts_and_numbers(item):
    for key, value in item.attrs.items():
        if key != "checksums":
            yield key, bytes(value) if isinstance(value, np.bytes_) else value
