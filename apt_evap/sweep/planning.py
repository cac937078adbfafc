"""The folder of a sweep: what is planned, and the state of each point."""

import csv
import io
import json
import math
import os
import re
from collections.abc import Iterator, Mapping
from dataclasses import asdict, dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

from apt_evap._common.codec import from_plain, to_plain
from apt_evap._common.files import FileError, read_small_file
from apt_evap._common.types import AnyPath
from apt_evap._common.validation import short_text
from apt_evap._version import __version__
from apt_evap.config.simulation_file import Config, config_of, key_of, read_document
from apt_evap.config.tables import check_table
from apt_evap.config.toml_text import toml_text
from apt_evap.simulation.checkpoint import Checkpoint
from apt_evap.storage.checked_hdf5 import label_of
from apt_evap.sweep.claims import Claim, Claims
from apt_evap.sweep.compare_settings import CompareSettings
from apt_evap.sweep.files import unlinked, write
from apt_evap.sweep.foresight import Foresight
from apt_evap.sweep.study_file import (
    POINTS,
    JobSettings,
    Point,
    SweepStudy,
    check_setting_path,
    folder_of_study,
    read_study,
    with_values,
)

_FORMAT = "apt_evap sweep 1"
_PLAN, _TABLE = "plan.json", "points.csv"
_MAX_BYTES = 1 << 30
_KEY = re.compile(r"[0-9a-f]{12}")
SETTINGS, RUN, LOG = "settings.toml", "run.h5", "log.txt"
"""Files of a point."""
INTERRUPTED = (130, 143, -2)
"""Exit codes of a run that was interrupted: it has saved its ions, or had just started."""
RETRY = 1000
"""Code of a claim that only makes the point open again; no exit code is above 255."""
STATES = ("done", "running", "open", "failed", "damaged", "foreign")
"""States of a point."""


@dataclass(frozen=True)
class PointState:
    """State of a point of a sweep.

    Parameters
    ----------
    name : {"done", "running", "open", "failed", "damaged", "foreign"}
        "open" also for a point that was interrupted or killed and will continue; "damaged" if its run cannot be read,
        "foreign" if its run has other settings than the point.
    claims : tuple of Claim
        All tries.
    message : str
        Reason of a failure, or who is at work.
    """

    name: str
    claims: tuple[Claim, ...] = ()
    message: str = ""

    @property
    def tries(self) -> int:
        """Number of times that a run was started."""
        return sum(1 for claim in self.claims if not claim.end or claim.end["code"] != RETRY)


@dataclass(frozen=True, repr=False)
class Sweep:
    """A planned sweep; made by `plan` and `open_sweep`.

    Parameters
    ----------
    folder : Path
        Its folder.
    points : tuple of Point
        The points, in the order of the study file.
    foresights : tuple of Foresight
        What each point needs.
    each : JobSettings
        How each point is run.
    compare : CompareSettings or None
        Comparison with a measured map.
    """

    folder: Path
    points: tuple[Point, ...]
    foresights: tuple[Foresight, ...]
    each: JobSettings
    compare: CompareSettings | None

    def __repr__(self) -> str:
        return f"<Sweep: {len(self.points):,} points in {str(self.folder)!r}>"

    @cached_property
    def by_key(self) -> dict[str, Point]:
        """Points by their keys."""
        return {point.key: point for point in self.points}

    @property
    def keys(self) -> tuple[str, ...]:
        """Keys of the points."""
        return tuple(point.key for point in self.points)

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

    def check_settings(self, key: str) -> None:
        """Check that the settings of a point on the disk are those of the plan; FileError otherwise."""
        path = self.folder_of(key) / SETTINGS
        document = read_document(path)
        config_of(document, path)
        if key_of(document) != key:
            raise FileError(f"{str(path)!r} has other settings than the plan: apt-evap sweep plan writes it again")

    def value(self, point: Point, path: str) -> Any:
        """Value of a setting at a point; None if neither the point nor the base has it."""
        if path in point.values:
            return point.values[path]
        table: Any = point.document
        for name in path.split("."):
            if not isinstance(table, Mapping) or name not in table:
                return None
            table = table[name]
        return table

    def check_key(self, key: str) -> str:
        """Return the key of a point, given by its key or its number from 0; ValueError otherwise."""
        if key in self.by_key:
            return key
        if key.isdecimal() and int(key) < len(self.points):
            return self.points[int(key)].key
        raise ValueError(f"a point must be a key of {_TABLE} or a number below {len(self.points)}, got {key!r}")

    def state(self, key: str) -> PointState:
        """State of a point, from its files."""
        try:
            folder = self.folder_of(key)
            claims = Claims(folder)
            return self._state(key, folder, tuple(claims.all()), claims.is_held)
        except FileError as error:
            return PointState("failed", message=str(error))

    def _state(self, key, folder, claims, is_held):
        last = claims[-1] if claims else None
        if last and last.end is None and is_held(last):
            return PointState("running", claims, last.who)
        there = os.path.lexists(folder / RUN)
        if there:
            name = str(folder / RUN)
            try:
                label = label_of(folder / RUN)
            except FileError as error:
                return PointState("damaged", claims, str(error))
            if label is None or label.kind != "run":
                return PointState("damaged", claims, f"{name!r} is not a complete file of a run")
            if label.note == key:
                return PointState("done", claims)
            if label.note:
                return PointState("foreign", claims, f"{name!r} is the run of other settings: {label.note}")
        if last and last.end and last.end["code"] not in (RETRY, *INTERRUPTED) and last.end["code"] >= 0:
            if last.end["code"] > 0:
                return PointState("failed", claims, last.end["message"] or f"exit code {last.end['code']}")
            if there:
                return PointState("failed", claims, f"the run in {str(folder / RUN)!r} is not complete")
        killed = self._killed_in_vain(folder, claims)
        if killed >= self.each.tries:
            return PointState("failed", claims, f"killed {killed} times without a new checkpoint")
        return PointState("open", claims)

    def _killed_in_vain(self, folder, claims):
        """Number of the last tries that were killed and added no ions."""
        ions, number = ions_of(folder), 0
        for claim in reversed(claims):
            was_killed = claim.end is None or claim.end["code"] < 0
            if not was_killed or claim.owner.get("ions", ions) != ions:
                break
            number += 1
        return number

    def states(self) -> Iterator[tuple[Point, PointState]]:
        """All points with their states."""
        for point in self.points:
            yield point, self.state(point.key)


def ions_of(folder: Path) -> int:
    """Number of ions that the run of a point has on the disk; 0 if a file is damaged."""
    try:
        return Checkpoint(folder / RUN).ions_there()
    except FileError:
        return 0


def plan(path: AnyPath) -> Sweep:
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
    study = read_study(path)
    folder = folder_of_study(path)
    _read_specimens(study)
    sweep = Sweep(folder, study.points, study.foresights, study.each, study.compare)
    try:
        for point in sweep.points:
            place = sweep.folder_of(point.key)
            place.mkdir(parents=True, exist_ok=True)
            write(place / SETTINGS, f"# made from {study.base.name}: {point}\n{_settings_text(point)}")
    except OSError as error:
        raise FileError(f"cannot write {error.filename!r}: {error.strerror}") from error
    write(folder / _TABLE, _table(sweep))
    write(folder / _PLAN, json.dumps(_content(study, sweep), indent=1) + "\n")
    return open_sweep(folder)


def _read_specimens(study):
    """Read every specimen from a file once, so that a wrong one is an error of the plan."""
    read = set()
    for point, config in zip(study.points, study.configs, strict=True):
        table = json.dumps(point.document["tip"])
        if "path" in config.tip and table not in read:
            config.specimen()
            read.add(table)


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
        content = json.loads(read_small_file(folder / _PLAN, _MAX_BYTES, "a plan"), parse_float=_finite)
        check_table(content, "its content")
        if content.get("format") != _FORMAT:
            raise ValueError(f"expected {_FORMAT!r}, got {short_text(content.get('format'))}")
        sweep = Sweep(
            folder,
            tuple(_point(**point) for point in content["points"]),
            tuple(from_plain(each, Foresight) for each in content["foresights"]),
            from_plain(content["each"], JobSettings),
            None if content["compare"] is None else CompareSettings.of(content["compare"], folder),
        )
        if not sweep.points or not len(sweep.points) == len(sweep.by_key) == len(sweep.foresights):
            raise ValueError("it must have points with different keys, and a foresight of each")
        sha256 = content["sha256"]
    except (ValueError, TypeError, KeyError, AttributeError, RecursionError) as error:
        raise FileError(f"{str(folder / _PLAN)!r} is not the plan of a sweep: {error}") from error
    path = Path(path)
    if path.is_file() and read_study(path).sha256 != sha256:
        raise FileError(f"{str(path)!r} or its base has changed since it was planned: run apt-evap sweep plan again")
    return sweep


def _finite(text):
    if not math.isfinite(number := float(text)):
        raise ValueError(f"numbers must be finite, got {text:.80}")
    return number


def _point(key, values, document):
    """A point from a plan; its key must be that of its settings, because it becomes a folder and a word of scripts."""
    for table, name in ((values, "values"), (document, "document")):
        check_table(table, name)
    for name in ("tip", "simulation"):
        check_table(document[name], name)
    if not isinstance(key, str) or not _KEY.fullmatch(key) or key != key_of(document):
        raise ValueError(f"the key of a point must be {key_of(document)!r}, as of its settings, got {short_text(key)}")
    for path in values:
        check_setting_path(path)
    own = with_values(document, values)
    check_table(own["tip"], "tip")
    own["tip"] = {
        **own["tip"],
        **{name: document["tip"][name] for name in ("file", "sha256") if name in document["tip"]},
    }
    if key_of(own) != key:
        raise ValueError(f"the values of point {key} must be those of its settings")
    return Point(key, values, document)


def _content(study: SweepStudy, sweep: Sweep) -> dict[str, Any]:
    return {
        "format": _FORMAT,
        "version": __version__,
        "study": study.path.name,
        "sha256": study.sha256,
        "base": study.base.name,
        "each": to_plain(sweep.each),
        "compare": sweep.compare and sweep.compare.to_table(),
        "points": [asdict(point) for point in sweep.points],
        "foresights": to_plain(sweep.foresights),
    }


def _settings_text(point: Point) -> str:
    return toml_text({key: value for key, value in point.document.items() if key != "output"})


def _table(sweep: Sweep) -> str:
    """Table of the points, as text with commas."""
    text = io.StringIO()
    table = csv.writer(text, lineterminator="\n")
    table.writerow(["point", "key", *sweep.paths, "ions", "atoms", "memory_GB", "hours"])
    for number, (point, needs) in enumerate(zip(sweep.points, sweep.foresights, strict=True)):
        values = [csv_value(sweep.value(point, path)) for path in sweep.paths]
        numbers = (needs.atoms, needs.memory and needs.memory / 1e9, needs.hours)
        foreseen = ["" if each is None else f"{each:.3g}" for each in numbers]
        table.writerow([number, point.key, *values, needs.ions, *foreseen])
    return text.getvalue()


def csv_value(value: Any) -> str:
    """A setting as text in a table: a word as it is, everything else as JSON."""
    return value if isinstance(value, str) else "" if value is None else json.dumps(value)
