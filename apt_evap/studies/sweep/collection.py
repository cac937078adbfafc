"""Collection of a sweep: a table of all points, the maps of all finished runs, and the comparison with a measurement.

All files are made from the plan and the files of the runs alone, and can be made again at any time.
"""

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from apt_evap import plot
from apt_evap._common.files import FileError, replace_file, sha256_of
from apt_evap._common.types import AnyPath
from apt_evap._common.validation import check_count
from apt_evap._common.version import __version__
from apt_evap.detection.detector_map import DetectorMap
from apt_evap.emission.perturbations import described
from apt_evap.fit.tips import TipFit, fit_tips
from apt_evap.plot.report.sweep_report import SweepRow
from apt_evap.simulation.run import load
from apt_evap.studies.sweep.planning import Sweep, csv_value
from apt_evap.studies.sweep.point_folder import RUN, PointState, unlinked, write_text

INDEX, MAPS, FIT_TABLE, FIT, REPORT = "index.csv", "maps.h5", "fit.csv", "fit.json", "report.html"
"""Files of a collection."""
DEFAULT_BINS = 128
_DRAWN = 12  # points whose maps are in the report
_OF_RUN = ("ions", "ended", "version", "created", "processor", "fingerprint")


def collect_sweep(
    sweep: Sweep,
    *,
    maps: AnyPath | None = None,
    bins: int | None = None,
    compare: bool = True,
    note: Callable[[str], object] = lambda text: None,
    command: str = "",
) -> dict[str, Any]:
    """Collect the results of the finished points of a sweep.

    Writes ``index.csv`` (all points: key, settings that differ, state, ions, end, version, processor,
    fingerprint of the bits), ``maps.h5`` (see `write_maps`) and, with a table ``[compare]``, ``fit.csv`` and
    ``fit.json`` (see `fit_tips`) to the folder of the sweep. ``report.html`` has all of this on one page, with the maps
    of the points that fit best (see `plot.write_sweep`).

    Only runs of the settings of their points are collected. A point whose run cannot be read, or is that of another
    point, is "wrong" in the tables, with the reason.

    Parameters
    ----------
    sweep : Sweep
        The sweep.
    maps : str or path-like, optional
        File of the maps, instead of ``maps.h5``.
    bins : int, optional
        Bins along a side of the maps; by default those of ``[maps]`` in the base, or 128.
    compare : bool
        Whether to compare with the measured map of ``[compare]``.
    note : callable, optional
        Called with a line of text on progress.
    command : str
        Command line to repeat the collection, for the report.

    Returns
    -------
    dict
        points, done (numbers), wrong (reasons by key of wrong points), files (list of str),
        fit (`TipFit` or None).

    Raises
    ------
    FileError
        If a file cannot be read or written.
    ValueError
        If no run can be compared.
    """
    if bins is not None:
        check_count(bins, "bins", at_least=1)
    states = {point.key: state for point, state in sweep.states()}
    rows: dict[str, dict[str, Any]] = {}
    for key, state in states.items():
        if state.name == "done":
            try:
                rows[key] = _row(sweep, key)
            except FileError as error:
                states[key] = PointState("wrong", str(error))
    done, fit = list(rows), None
    note(f"{len(done):,} of {len(sweep.points):,} points are done")
    nothing = dict.fromkeys(_OF_RUN, "")
    columns = {
        key: {"state": state.name, "message": state.message} | rows.get(key, nothing) for key, state in states.items()
    }
    sweep.write_table(INDEX, columns)
    files = [str(sweep.folder / INDEX)]
    if done:
        target = Path(maps) if maps is not None else unlinked(sweep.folder / MAPS)
        panels = write_maps(sweep, done, target, bins)
        files.append(str(target))
    if compare and sweep.compare is not None and done:
        note(f"comparing {len(done):,} runs with {sweep.compare.measured}")
        fit = _compare(sweep, done)
        files += [str(sweep.folder / name) for name in (FIT_TABLE, FIT)]
    if done:
        _write_report(sweep, states, rows, fit, command, panels)
        files.append(str(sweep.folder / REPORT))
    wrong = {key: state.message for key, state in states.items() if state.name == "wrong"}
    return {"points": len(sweep.points), "done": len(done), "wrong": wrong, "files": files, "fit": fit}


def _row(sweep, key):
    """Results of a point from its run, which is read completely; FileError if it is wrong."""
    path = sweep.folder_of(key) / RUN
    run = load(path)
    if run.provenance.get("settings") != key:
        raise FileError(f"{str(path)!r} is the run of other settings")
    systems = run.provenance.get("systems") or [{}]
    return {
        "ions": len(run),
        "ended": run.ended or "as planned",
        "version": run.provenance.get("version", ""),
        "created": run.provenance.get("created", ""),
        "processor": "; ".join(dict.fromkeys(system.get("processor", "") for system in systems)),
        "fingerprint": run.fingerprint(),
    }


def _write_report(sweep, states, rows, fit, command, panels):
    studies, failed = ({}, {}) if fit is None else (fit.studies, fit.failed)
    points = []
    for point in sweep.points:
        state, study = states[point.key], studies.get(point.key)
        maps = {}
        if study is not None:
            pair = {"measured": study.measured, "simulated": study.maps["optimum"]}
            maps = {title: study.compared(map) for title, map in pair.items()}
        unfinished = state.message or ("" if state.name == "done" else state.name)
        points.append(
            SweepRow(
                name=point.key,
                settings={path: sweep.value(point, path) for path in sweep.paths},
                results={"ions": rows[point.key]["ions"]} if point.key in rows else {},
                study=None if study is None else study.to_dict(),
                maps=maps,
                panels=panels.get(point.key, {}),
                message=unfinished or failed.get(point.key, ""),
            )
        )
    files = [sweep.folder / INDEX]
    if fit is not None:
        files.append(sweep.compare.measured)
    target = unlinked(sweep.folder / REPORT)
    plot.write_sweep(points, target, title=f"Sweep {sweep.folder.name}", files=files, command=command)


def write_maps(
    sweep: Sweep, keys: list[str], path: AnyPath, bins: int | None = None
) -> dict[str, dict[str, DetectorMap]]:
    """Write the maps of runs to one rectangular HDF5 file, which xarray and other readers of netCDF-4 open.

    The dimensions of ``maps`` are point, perturbation, y and x; its values are hits per bin, on the same bins for all
    points. The perturbations are the panels of ``[maps]`` in the base. Further variables: ``x``, ``y`` (centres [mm]),
    ``x_edges``, ``y_edges`` [mm], ``key``, ``perturbation``, ``ions`` and the settings in which the points differ, with
    ``_`` instead of the dots: numbers as numbers, everything else as JSON.
    """
    configs = [sweep.config_of(key) for key in keys]
    panels = configs[0].maps.panels
    bins = bins or configs[0].maps.bins or DEFAULT_BINS
    grid = max((config.detector for config in configs), key=lambda detector: detector.width).grid(bins)
    edges = grid.x_edges
    drawn: dict[str, dict[str, DetectorMap]] = {key: {} for key in keys[:_DRAWN]}
    with replace_file(path) as target, h5py.File(target, "w") as file:
        file.attrs["made_by"] = f"apt_evap {__version__}"
        file.attrs["sweep"] = sweep.folder.name
        shape = len(keys), len(panels), bins, bins
        counts = file.create_dataset("maps", shape, np.int32, chunks=(1, 1, bins, bins), compression="gzip")
        counts.attrs["long_name"] = "hits per bin"
        ions = np.zeros(len(keys), np.int64)
        for row, key in enumerate(keys):
            run = load(sweep.folder_of(key) / RUN)
            ions[row] = len(run)
            for column, panel in enumerate(panels):
                hits, values = run.hits(panel.perturbation), np.zeros((bins, bins), np.int32)
                if hits.detected.any():
                    values[:] = hits.map(like=grid, position_step=None).values
                counts[row, column] = values
                if key in drawn:
                    drawn[key][panel.title] = DetectorMap.from_array(values, edges, edges, is_counts=True)
        # each dimension is a scale of the same name, as in netCDF-4
        _put(file, "point", np.arange(len(keys)))
        _put(file, "perturbation", [json.dumps(described(panel.perturbation)) for panel in panels])
        for axis in ("y", "x"):
            _put(file, axis, (edges[1:] + edges[:-1]) / 2, "mm")
        for axis, name in enumerate(("point", "perturbation", "y", "x")):
            file[name].make_scale(name)
            counts.dims[axis].attach_scale(file[name])
        for axis in ("x", "y"):
            _put(file, f"{axis}_edges", edges, "mm").make_scale(f"{axis}_edges")
        _put(file, "title", [panel.title for panel in panels]).dims[0].attach_scale(file["perturbation"])
        columns = {"key": keys, "ions": ions}
        for path_of_setting in sweep.paths:
            values = [sweep.value(sweep.by_key[key], path_of_setting) for key in keys]
            columns[path_of_setting.replace(".", "_")] = _column(values)
        for name, values in columns.items():
            _put(file, name, values).dims[0].attach_scale(file["point"])
    return drawn


def _column(values):
    """Values of a setting: numbers if all are, otherwise text."""
    if all(isinstance(value, int | float) and not isinstance(value, bool) for value in values):
        return np.array(values, float)
    return [csv_value(value) for value in values]


def _put(file, name, values, units=None):
    is_text = isinstance(values, list)
    values = np.array(values, dtype=object) if is_text else values
    dataset = file.create_dataset(name, data=values, dtype=h5py.string_dtype() if is_text else None)
    if units:
        dataset.attrs["units"] = units
    return dataset


def _compare(sweep: Sweep, keys: list[str]) -> TipFit:
    """Compare the runs of points with the measured map; write the tables."""
    settings: Any = sweep.compare
    runs = {key: sweep.folder_of(key) / RUN for key in keys}
    fit = fit_tips(runs, settings.read(), settings.grid, settings.settings, progress=False)
    rows = fit.rows()
    columns = {row["run"]: {name: _cell(value) for name, value in row.items() if name != "run"} for row in rows}
    sweep.write_table(FIT_TABLE, columns)
    content = {
        "made_by": f"apt_evap {__version__}",
        "compare": settings.to_table() | {"sha256": sha256_of(settings.measured)},
        "best": fit.best,
        "settings_of_best": sweep.by_key[fit.best].values,
        "failed": fit.failed,
        "table": rows,
        "studies": {key: study.to_dict() for key, study in fit.studies.items()},
    }
    write_text(sweep.folder / FIT, json.dumps(content, indent=1, allow_nan=False) + "\n")
    return fit


def _cell(value):
    return "" if value is None else f"{value:.6g}" if isinstance(value, float) else value
