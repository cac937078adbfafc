"""The folder of a sweep: what is planned, and the state of each point."""

import csv
import io
import json
import statistics
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

from apt_evap._common.codec import from_plain, to_plain
from apt_evap._common.files import FileError, read_small_file
from apt_evap._common.notebook import as_table
from apt_evap._common.types import AnyPath
from apt_evap._common.validation import short_text
from apt_evap._common.version import __version__
from apt_evap.simulation.config.cost_estimate import CostEstimate
from apt_evap.simulation.config.simulation_file import config_of, key_of
from apt_evap.simulation.config.simulation_settings import Config
from apt_evap.simulation.config.tables import check_table
from apt_evap.simulation.config.toml_text import comment, toml_text
from apt_evap.studies.sweep.compare_settings import CompareSettings
from apt_evap.studies.sweep.point_folder import (
    SETTINGS,
    STATES,
    PointState,
    ions_of,
    state_of,
    try_again,
    unlinked,
    write_text,
)
from apt_evap.studies.sweep.study_file import (
    POINTS,
    JobSettings,
    Point,
    SweepStudy,
    check_setting_path,
    folder_of_study,
    read_study,
    value_at,
)

_FORMAT = "apt_evap sweep 2"
_PLAN, _TABLE = "plan.json", "points.csv"
_MAX_BYTES = 1 << 30


@dataclass(frozen=True, repr=False)
class Sweep:
    """A planned sweep; made by `plan_sweep` and `open_sweep`."""

    folder: Path
    points: tuple[Point, ...]
    job: JobSettings
    compare: CompareSettings | None

    def __repr__(self) -> str:
        return f"<Sweep: {len(self.points):,} points in {str(self.folder)!r}>"

    _repr_html_ = as_table

    def notebook_contents(self) -> dict[str, Any]:
        """Table that a notebook shows: settings that vary, and the number of points in each state, dict."""
        states = [state.name for _, state in self.states()]
        counts = {name: states.count(name) for name in STATES if name in states}
        return {"folder": str(self.folder), "settings_that_vary": list(self.paths), "points": counts}

    @cached_property
    def by_key(self) -> dict[str, Point]:
        """Points by their keys."""
        return {point.key: point for point in self.points}

    @property
    def keys(self) -> tuple[str, ...]:
        """Keys of the points."""
        return tuple(self.by_key)

    @property
    def paths(self) -> tuple[str, ...]:
        """Paths of the settings in which points differ."""
        return tuple(dict.fromkeys(path for point in self.points for path in point.values))

    def folder_of(self, key: str) -> Path:
        """Folder of a point; FileError if it is a link."""
        return unlinked(unlinked(self.folder / POINTS) / key)

    def config_of(self, key: str) -> Config:
        """Settings of a point; FileError if they are wrong."""
        return config_of(self.by_key[key].document, self.folder_of(key) / SETTINGS)

    def value(self, point: Point, path: str) -> Any:
        """Value of a setting at a point; None if neither the point nor the base has it."""
        return value_at(point.document, path)

    def check_key(self, key: str) -> str:
        """Return the key of a point, which is its key or its number from 0; ValueError otherwise."""
        if key in self.by_key:
            return key
        if key.isdecimal() and int(key) < len(self.points):
            return self.points[int(key)].key
        raise ValueError(
            f"a point must be a key of {_TABLE} or a number below {len(self.points)}, got {short_text(key)}"
        )

    def state(self, key: str) -> PointState:
        """State of a point, from its files."""
        try:
            return state_of(self.folder_of(key))
        except FileError as error:
            return PointState("wrong", str(error), None)

    def states(self) -> Iterator[tuple[Point, PointState]]:
        """All points with their states."""
        for point in self.points:
            yield point, self.state(point.key)

    def write_table(self, name: str, rows: Mapping[str, Mapping[str, Any]]) -> None:
        """Write a CSV file of points with their numbers, keys and settings that differ."""
        text, numbers = io.StringIO(), {key: number for number, key in enumerate(self.by_key)}
        table = csv.writer(text, lineterminator="\n")
        table.writerow(["point", "key", *self.paths, *next(iter(rows.values()))])
        for key, row in rows.items():
            values = [csv_value(self.value(self.by_key[key], path)) for path in self.paths]
            table.writerow([numbers[key], key, *values, *row.values()])
        write_text(self.folder / name, text.getvalue())


def plan_sweep(path: AnyPath) -> Sweep:
    """Plan the sweep of a study file: make its folder with one folder for each point. Nothing is run.

    A sweep can be planned again after a change of the study file. Points with unchanged settings keep their runs.

    Parameters
    ----------
    path : str or path-like
        The study file.

    Returns
    -------
    Sweep

    Raises
    ------
    FileError
        If the study is wrong, or a file cannot be written.
    """
    return make_plan(read_study(path))


def make_plan(study: SweepStudy) -> Sweep:
    """Plan the sweep of a study that is read already, see `plan_sweep`."""
    folder = folder_of_study(study.path)
    tables = set()
    for point, config in zip(study.points, study.configs, strict=True):
        if "path" in config.tip and (table := json.dumps(point.document["tip"])) not in tables:
            config.specimen()  # a wrong file is an error of the plan
            tables.add(table)
    sweep = Sweep(folder, study.points, study.job, study.compare)
    try:
        for point in sweep.points:
            place = sweep.folder_of(point.key)
            place.mkdir(parents=True, exist_ok=True)
            settings = toml_text({key: value for key, value in point.document.items() if key != "output"})
            write_text(place / SETTINGS, f"{comment(f'made from {study.base.name}: {point}')}\n{settings}")
    except OSError as error:
        raise FileError(f"cannot write {error.filename!r}: {error.strerror}") from error
    sweep.write_table(_TABLE, {point.key: _columns(point.estimate) for point in sweep.points})
    content = {
        "format": _FORMAT,
        "version": __version__,
        "study": study.path.name,
        "sha256": study.sha256,
        "base": study.base.name,
        "each": to_plain(sweep.job),
        "compare": sweep.compare and sweep.compare.to_table(),
        "points": [
            {
                "key": point.key,
                "paths": list(point.values),
                "document": point.document,
                "estimate": to_plain(point.estimate),
            }
            for point in sweep.points
        ],
    }
    write_text(folder / _PLAN, json.dumps(content, indent=1) + "\n")
    return open_sweep(folder)


def open_sweep(path: AnyPath) -> Sweep:
    """Open a planned sweep.

    Parameters
    ----------
    path : str or path-like
        The study file, or the folder of the sweep.

    Returns
    -------
    Sweep

    Raises
    ------
    FileError
        If the sweep is not planned, its plan is wrong, or the study, its base or a specimen has changed since.
    """
    folder = folder_of_study(path)
    if not (folder / _PLAN).exists():
        raise FileError(f"{str(path)!r} is not planned yet: apt-evap sweep plan makes its folder {str(folder)!r}")
    try:
        content = json.loads(read_small_file(folder / _PLAN, _MAX_BYTES, "a plan"))
        check_table(content, "the content")
        if content.get("format") != _FORMAT:
            raise ValueError(f"format must be {_FORMAT!r}, got {short_text(content.get('format'))}")
        sweep = Sweep(
            folder,
            tuple(map(_point, content["points"])),
            from_plain(content["each"], JobSettings),
            None if content["compare"] is None else CompareSettings.of(content["compare"], folder),
        )
        if not sweep.points or len(sweep.points) != len(sweep.by_key):
            raise ValueError("it must have points with different keys")
        sha256 = content["sha256"]
    except (ValueError, TypeError, KeyError, AttributeError, RecursionError) as error:
        raise FileError(f"{str(folder / _PLAN)!r} is not the plan of a sweep: {error}") from error
    path = Path(path)
    if path.is_file() and read_study(path).sha256 != sha256:
        raise FileError(f"{str(path)!r} or its base has changed since it was planned: run apt-evap sweep plan again")
    return sweep


def _point(content):
    """A point of a plan. Its key becomes a folder: it must be that of its settings."""
    document = content["document"]
    for name in ("tip", "simulation"):
        check_table(document[name], name)
    key = key_of(document)
    if content["key"] != key:
        raise ValueError(f"the key of a point must be {key!r}, as of its settings, got {short_text(content['key'])}")
    values = {}
    for path in content["paths"]:
        check_setting_path(path)
        values[path] = value_at(document, path)
        if values[path] is None:
            raise ValueError(f"the paths of point {key} must be settings of it, got {short_text(path)}")
    return Point(key, values, document, from_plain(content["estimate"], CostEstimate))


def _columns(cost):
    """Estimates in the table of the points."""
    numbers = {"atoms": cost.atoms, "memory_GB": cost.memory and cost.memory / 1e9, "hours": cost.hours}
    return {"ions": cost.ions} | {name: "" if value is None else f"{value:.3g}" for name, value in numbers.items()}


def csv_value(value: Any) -> str:
    """A setting as text in a table: a word as it is, everything else as JSON."""
    return value if isinstance(value, str) else "" if value is None else json.dumps(value)


def retry(sweep: Sweep) -> int:
    """Let all failed points wait for another try."""
    failed = [point.key for point, state in sweep.states() if state.name == "failed"]
    for key in failed:
        try_again(sweep.folder_of(key))
    return len(failed)


def sweep_status(sweep: Sweep) -> dict[str, Any]:
    """Status of a sweep in plain types.

    Parameters
    ----------
    sweep : Sweep
        The sweep.

    Returns
    -------
    dict
        folder, points (number), counts (by state), hours_left (of one worker; corrected by the measured speed of
        finished points; None if not known), memory (largest of a point that is not done [bytes]) and table: for each
        point its key, values, state, message, ions, n_ions, seconds.
    """
    table, speeds, left, memory = [], [], [], []
    for point, state in sweep.states():
        cost = point.estimate
        ions = 0 if state.name == "wrong" else ions_of(sweep.folder_of(point.key))
        if state.name == "done" and cost.hours and state.seconds:
            speeds.append(state.seconds / (3600 * cost.hours))
        if state.name in ("waiting", "running"):
            left.append(None if cost.hours is None else cost.hours * max(0.0, 1 - ions / cost.ions))
        if state.name != "done":
            memory.append(cost.memory or 0.0)
        table.append(
            {
                "key": point.key,
                "values": point.values,
                "state": state.name,
                "message": state.message,
                "ions": ions,
                "n_ions": cost.ions,
                "seconds": None if state.seconds is None else round(state.seconds, 3),
            }
        )
    speed = statistics.median(speeds) if speeds else 1.0  # seconds per estimated second
    hours = None if None in left else speed * sum(hours for hours in left if hours is not None)
    return {
        "folder": str(sweep.folder),
        "points": len(table),
        "counts": {name: sum(row["state"] == name for row in table) for name in STATES},
        "hours_left": hours,
        "memory": max(memory, default=0.0),
        "table": table,
    }
