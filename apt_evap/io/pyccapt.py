"""HDF5 files of PyCCAPT, the software of the OXCART atom probe: the instrument's own, and those of its calibration.

The instrument writes one dataset for each column into the group ``dld``: detector coordinates in cm, times in ns. The
calibration writes a DataFrame of pandas with the name ``df``, whose columns have names such as "x_det (cm)". This is
what `write_pyccapt` writes, too, without pandas: its blocks and attributes are those of ``to_hdf(path, key="df")``.
"""

from collections.abc import Sequence

import h5py
import numpy as np

from apt_evap._common.checked_hdf5 import CheckedFile, label_of, open_hdf5, put_field, write_hdf5
from apt_evap._common.files import FileError, check_path
from apt_evap._common.types import AnyPath
from apt_evap._common.validation import short_text
from apt_evap.detection.hits import Hits
from apt_evap.io._pulses import are_grouped, first_from_equal, ions_per_pulse, pulses_from_first
from apt_evap.io._records import check_any, check_columns, choose
from apt_evap.io.nxapm import numbers

_MM_PER_CM = 10.0
_MAX_BLOCKS = 100
# names in the group dld, of the newest version first, and factors to the units of `Hits`
_INSTRUMENT = {
    "x": (("x",), _MM_PER_CM),
    "y": (("y",), _MM_PER_CM),
    "time_of_flight": (("t",), 1.0),
    "voltage": (("high_voltage",), 1.0),
    "pulse_voltage": (("voltage_pulse", "pulse_voltage", "pulse"), 1.0),
    "laser_pulse": (("laser_pulse", "laser_intensity"), 1.0),
    "start_counter": (("start_counter",), 1.0),
}
_CALIBRATED = {
    "x": (("x_det (cm)",), _MM_PER_CM),
    "y": (("y_det (cm)",), _MM_PER_CM),
    "time_of_flight": (("t (ns)",), 1.0),
    "voltage": (("high_voltage (V)", "high-voltage (V)"), 1.0),
    "pulse_voltage": (("pulse_v (V)", "pulse"), 1.0),
    "mass_to_charge": (("mc_c (Da)", "mc (Da)"), 1.0),
    "position_x": (("x (nm)",), 1.0),
    "position_y": (("y (nm)",), 1.0),
    "position_z": (("z (nm)",), 1.0),
    "laser_pulse": (("pulse_l (pJ)",), 1.0),
    "calibrated_time_of_flight": (("t_c (ns)",), 1.0),
    "uncalibrated_mass_to_charge": (("mc_uc (Da)",), 1.0),
    "start_counter": (("start_counter",), 1.0),
    "pulses": (("delta_p",), 1.0),
    "multi": (("multi",), 1.0),
}
_POSITIONS = ("position_x", "position_y", "position_z")
_EXTRA = {
    "laser_pulse": "pJ",
    "calibrated_time_of_flight": "ns",
    "uncalibrated_mass_to_charge": "Da",
    "start_counter": "",
    "multi": "",
}
_TABLE = (  # columns of a calibration in their order, with those of `Hits`, and factors to their units
    ("x (nm)", "position_x", 1.0),
    ("y (nm)", "position_y", 1.0),
    ("z (nm)", "position_z", 1.0),
    ("mc (Da)", "mass_to_charge", 1.0),
    ("mc_uc (Da)", "uncalibrated_mass_to_charge", 1.0),
    ("high_voltage (V)", "voltage", 1.0),
    ("pulse_v (V)", "pulse_voltage", 1.0),
    ("pulse_l (pJ)", "laser_pulse", 1.0),
    ("t (ns)", "time_of_flight", 1.0),
    ("t_c (ns)", "calibrated_time_of_flight", 1.0),
    ("x_det (cm)", "x", 1 / _MM_PER_CM),
    ("y_det (cm)", "y", 1 / _MM_PER_CM),
)
_COUNTED = (("delta_p", "pulses", 1), ("multi", "multi", 1), ("start_counter", "start_counter", 1))  # integers
_ROWS = 1 << 13  # of a chunk of the file
KIND = "PyCCAPT"
WRITTEN = ("positions", "mass_to_charge", "voltage", "pulse_voltage", "time_of_flight", "x", "y", "pulses")
_CONTINUOUS = ("x", "y", "time_of_flight")  # integers are raw counts of the detector
_KEPT = ("x", "y", "pulse_voltage")  # columns that may be zero for all ions


def read_pyccapt(path: AnyPath, *, columns: Sequence[str] | None = None) -> Hits:
    """Read an HDF5 file of PyCCAPT, of the instrument or of the calibration.

    Consecutive ions with the same start counter belong to one pulse; without start counters, the column multi of the
    calibration is used. Other columns of zeros are treated as absent. Integers as coordinates or times are raw counts
    of the detector, and an error: their scale depends on the version of PyCCAPT. In files of early versions the column
    ``pulse`` is the pulse voltage or the power of the laser, read as a voltage.

    Returns
    -------
    Hits
        With x, y [mm], time_of_flight [ns], voltage, pulse_voltage [V], pulse_id and multiplicity; after a calibration
        also mass_to_charge [Da], positions [nm] and pulses. ``extra`` contains "start_counter", "laser_pulse" [pJ],
        "calibrated_time_of_flight" [ns], "uncalibrated_mass_to_charge" [Da] and, if it is not used, "multi".
    """
    with open_hdf5(path, "a file of PyCCAPT") as file:
        if "dld" in file:
            columns_read = _instrument(file)
        elif "df" in file:
            columns_read = _calibrated(file, file.name)
        else:
            raise FileError(f"{file.name!r} is not a file of PyCCAPT: it has neither a group 'dld' nor a group 'df'")
        return _hits(columns_read, file.name, columns)


def _instrument(file):
    """Columns in the group dld."""
    columns = {}
    for column, (names, factor) in _INSTRUMENT.items():
        stored = next((f"dld/{name}" for name in names if f"dld/{name}" in file), None)
        if stored is not None:
            columns[column] = _scaled(_one_column(numbers(file, stored, compressed=True), stored), factor)
    return columns


def _one_column(values, name):
    if values.ndim > 1 and values.shape[1:] != (1,):
        raise ValueError(f"{name} must have one value per ion, got shape {values.shape}")
    return values.reshape(len(values))


def _calibrated(file, path):
    """Columns of the DataFrame df, which pandas stores as blocks of columns of the same type."""
    if "df/table" in file:
        raise FileError(
            f"{path!r} contains a table of pandas (format='table'), expected format='fixed', as PyCCAPT writes it: "
            "to_hdf(path, key='df', format='fixed')"
        )
    known_names = {
        name: (column, factor) for column, (names, factor) in _CALIBRATED.items() for name in reversed(names)
    }
    known, table = [], {}
    for index in range(_MAX_BLOCKS):
        if f"df/block{index}_items" not in file:
            break
        items = file.read(f"df/block{index}_items", None, None, compressed=True)
        if items.dtype.kind != "S" or len(items.shape) != 1:
            raise ValueError(f"df/block{index}_items must contain the names of columns")
        names = [name.decode("utf-8", "replace") for name in items.tolist()]
        known += names
        if not any(name in known_names for name in names):
            continue  # a block of texts or lists
        values = numbers(file, f"df/block{index}_values", compressed=True)
        if values.ndim != 2 or values.shape[1] != len(names):
            raise ValueError(f"df/block{index}_values must have {len(names)} columns, got shape {values.shape}")
        table |= {name: values[:, k] for k, name in enumerate(names) if name in known_names}
    if "mc_low" in known:
        raise FileError(f"{path!r} contains the mass ranges of PyCCAPT, expected its ions")
    columns = {}
    for column, (names, factor) in _CALIBRATED.items():
        # the first name that is not zero for all ions: columns of steps that were not done yet are zero
        stored = [table[name] for name in names if name in table]
        if stored:
            columns[column] = _scaled(next((values for values in stored if values.any()), stored[0]), factor)
    return columns


def _scaled(values, factor):
    if factor == 1.0 or values.dtype.kind != "f":  # integers as coordinates are refused
        return np.ascontiguousarray(values)
    return values * factor


def _hits(table, path, columns):
    if "x" not in table or "y" not in table:
        raise FileError(
            f"{path!r} has no detector coordinates of PyCCAPT (x and y of dld, or x_det (cm) and y_det (cm))"
        )
    lengths = {name: len(values) for name, values in table.items()}
    if len(set(lengths.values())) > 1:
        raise FileError(f"{path!r}: columns of PyCCAPT must have equal lengths, got {lengths}")
    counts = [name for name in _CONTINUOUS if name in table and table[name].dtype.kind in "iu"]
    if counts:
        raise FileError(
            f"{path!r}: {', '.join(counts)} are integers, raw counts of the detector, expected cm and ns: convert them "
            "with the constants of this instrument (in PyCCAPT 78 or 80 mm for 2,450 bins, and 6.858 ps)"
        )
    table = {name: values for name, values in table.items() if name in _KEPT or values.any()}
    if all(name in table for name in _POSITIONS):
        table["positions"] = np.column_stack([table.pop(name) for name in _POSITIONS])
    table = {name: values for name, values in table.items() if name not in _POSITIONS}
    if "start_counter" in table and len(table["x"]) and are_grouped([table["start_counter"]], path):
        table["pulse_id"], table["multiplicity"] = pulses_from_first(first_from_equal(table["start_counter"]))
    elif "multi" in table and (ions := ions_per_pulse(table["multi"])[0]) is not None:
        table["pulse_id"], table["multiplicity"] = pulses_from_first(ions)
        table.pop("multi")
    chosen = check_columns(columns, tuple(table), path)
    requested = {name: table[name] for name in chosen}
    check_any(requested, path)
    extra = {name: requested.pop(name) for name in _EXTRA if name in requested}
    units = {name: _EXTRA[name] for name in extra if _EXTRA[name]}
    return Hits(**requested, extra=extra, units=units, source=path)


def write_pyccapt(path: AnyPath, hits: Hits) -> None:
    """Write ions as a calibrated file of PyCCAPT, which it reads as "processed".

    All floats are float64, as in PyCCAPT, and all counts int64. Missing columns are zeros. The start counter is that in
    ``extra``, or else the number of the pulse; "multi" is the number of ions of a pulse for each of its ions.
    """
    place = check_path(path)
    if place.is_file() and (label := _label(place)) is not None and label.kind.split()[0] == "run":
        raise FileError(f"{str(path)!r} is a run, which ions do not replace: expected another name")
    if hits.x is None or hits.y is None:
        raise ValueError(f"hits must have detector coordinates x and y for {str(path)!r}, got {short_text(hits)}")
    columns = {name: getattr(hits, name) for name in WRITTEN} | dict(hits.extra)
    floats = [columns[name] for name in WRITTEN if name != "pulses"]
    chosen = choose(path, hits, [(0, values, "f4") for values in floats])
    if hits.positions is not None:
        columns |= dict(zip(_POSITIONS, hits.positions.T, strict=True))
    if hits.pulse_id is not None:
        columns.setdefault("start_counter", hits.pulse_id + 1)  # a column of zeros is absent
        ions = first_from_equal(hits.pulse_id[chosen])
        columns["multi"] = np.zeros(len(hits), np.int64)
        columns["multi"][chosen] = np.repeat(ions[ions > 0], ions[ions > 0])
    n = len(hits.x[chosen])

    def block(titles, dtype):
        """Rows of a block of columns with their factors, in parts."""
        parts = [(columns.get(name), factor) for _, name, factor in titles]
        parts = [(None if values is None else values[chosen], factor) for values, factor in parts]
        for start in range(0, n, _ROWS):
            rows = np.zeros((min(_ROWS, n - start), len(titles)), dtype)
            for k, (values, factor) in enumerate(parts):
                if values is not None:
                    part = values[start : start + len(rows)].astype(dtype)
                    rows[:, k] = part if factor == 1 else part * factor
            yield rows

    with write_hdf5(path, KIND, n) as file:
        group = file.create_group("df")
        names = [name for name, *_ in (*_TABLE, *_COUNTED)]
        regular = {f"{name}_variety": "regular" for name in ("axis0", "axis1", "block0_items", "block1_items")}
        texts = {"CLASS": "GROUP", "TITLE": "", "VERSION": "1.0", "pandas_type": "frame", **regular}
        _put_attributes(group, {**texts, "encoding": "UTF-8", "errors": "strict"})
        group.attrs["ndim"], group.attrs["nblocks"] = np.int64(2), np.int64(2)
        _put_array(group, "axis0", np.array(names, "S"), "string")
        _put_array(group, "axis1", np.arange(n), "integer")
        for k, (titles, dtype) in enumerate(((_TABLE, np.float64), (_COUNTED, np.int64))):
            _put_array(group, f"block{k}_items", np.array([title for title, *_ in titles], "S"), "string")
            shape = (n, len(titles))
            chunks = (min(n, _ROWS), len(titles))
            values = group.create_dataset(
                f"block{k}_values", shape, dtype, chunks=chunks, compression="gzip", compression_opts=0
            )
            for start, rows in enumerate(block(titles, dtype)):
                values[start * _ROWS : start * _ROWS + len(rows)] = rows
            _mark_array(values)


def _label(path):
    """Label of an HDF5 file of this package; None for other files."""
    try:
        return label_of(path)
    except FileError:
        return None


def _put_array(group, name, values, kind=None):
    """Write an array with the attributes of pandas."""
    dataset = put_field(group, name, values)
    _mark_array(dataset)
    if kind:
        _put_attributes(dataset, {"kind": kind})
    if kind == "string":
        _put_attributes(dataset, {"nan_rep": "nan"})


def _mark_array(dataset):
    """Attributes of an array of pandas."""
    dataset.attrs["transposed"] = np.uint8(1)
    _put_attributes(dataset, {"CLASS": "CARRAY", "TITLE": "", "VERSION": "1.1", "FLAVOR": "numpy"})


def _put_attributes(item, texts):
    """Write texts of fixed length as attributes, as PyTables does."""
    for name, text in texts.items():
        if text:
            item.attrs.create(name, text.encode(), dtype=h5py.string_dtype("utf-8", len(text)))
        else:
            item.attrs[name] = h5py.Empty("S1")


def is_pyccapt(file: CheckedFile) -> bool:
    """Whether an open HDF5 file has the groups of PyCCAPT."""
    return "dld" in file or "df" in file
