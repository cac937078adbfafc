"""The study file of a sweep: common settings, and the values that are combined."""

import copy
import hashlib
import itertools
import json
from collections.abc import Mapping
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

from apt_evap._common.files import FileError
from apt_evap._common.types import AnyPath
from apt_evap._common.validation import check_count, check_number, short_text
from apt_evap.config.simulation_file import Config, config_of, read_document
from apt_evap.config.tables import check_keys, check_table
from apt_evap.sweep.compare_settings import CompareSettings
from apt_evap.sweep.foresight import Foresight, foresee

MAX_POINTS = 100_000  # a larger product is a typing error
_DIGITS = 12  # of a key: two of 100,000 points have the same one with a probability of 2e-5
_FIXED = ("output", "maps")  # not settings of the simulation


@dataclass(frozen=True)
class JobSettings:
    """How each point is run; not part of its settings.

    Parameters
    ----------
    threads : int
        Threads of a run. Two threads are 1.65 to 1.81 times as fast as one: while memory lasts, many runs of one
        thread finish earlier.
    checkpoint : float
        Time between two checkpoints [min].
    hours : float, optional
        Time limit of a job of a batch system [h]. An interrupted run continues in the next job.
    tries : int
        Number of tries in succession that are killed without a new checkpoint, after which a point counts as failed.

    Raises
    ------
    ValueError
        If a value is outside its range.
    """

    threads: int = 1
    checkpoint: float = 10.0
    hours: float | None = None
    tries: int = 3

    def __post_init__(self):
        check_count(self.threads, "threads", at_least=1)
        check_number(self.checkpoint, "checkpoint", at_least=0, unit="min")
        check_count(self.tries, "tries", at_least=1)
        if self.hours is not None:
            check_number(self.hours, "hours", above=0, unit="h")


@dataclass(frozen=True)
class Point:
    """One simulation of a sweep.

    Parameters
    ----------
    key : str
        First 12 digits of the SHA-256 of the complete settings, see `key_of`.
    values : dict
        What this point has of its own: values by path, such as ``{"tip.axis": [1, 1, 1]}``.
    document : dict
        Complete settings, as in a file of `apt-evap run`.
    """

    key: str
    values: dict
    document: dict

    def __str__(self):
        return ", ".join(f"{path} = {json.dumps(value)}" for path, value in self.values.items()) or "the base"


@dataclass(frozen=True)
class SweepStudy:
    """Content of a study file; made by `read_study`.

    Parameters
    ----------
    path : Path
        The study file.
    base : Path
        File with the common settings.
    points : tuple of Point
        All points, each once.
    configs : tuple of Config
        Their settings, validated.
    foresights : tuple of Foresight
        What each of them needs.
    each : JobSettings
        How each point is run.
    compare : CompareSettings or None
        Comparison with a measured map.
    sha256 : str
        Of the bytes of both files.
    """

    path: Path
    base: Path
    points: tuple[Point, ...]
    configs: tuple[Config, ...]
    foresights: tuple[Foresight, ...]
    each: JobSettings
    compare: CompareSettings | None
    sha256: str


def read_study(path: AnyPath) -> SweepStudy:
    """Read a study file.

    ``base`` is the file of settings that all points share (of `apt-evap run`, relative to the study file). ``[sweep]``
    contains lists of values by path; all combinations are points. Each ``[[points]]`` is one more point. Paths are
    quoted: ``"tip.axis" = [[0, 0, 1], [1, 1, 1]]``. ``[each]`` contains the fields of `JobSettings`, ``[compare]`` a
    measured file and the parameters of `fit_tips`.

    Parameters
    ----------
    path : str or path-like
        The study file.

    Returns
    -------
    SweepStudy

    Raises
    ------
    FileError
        If a file cannot be read, a key or value is wrong, or the settings of a point are invalid; the message names it.
    """
    path = Path(path)
    table = read_document(path)
    try:
        check_keys(table, ("base", "each", "compare", "sweep", "points"), ("base",))
        base = table["base"]
        if not isinstance(base, str) or not base:
            raise ValueError(f"base must be a file name such as 'ni111.toml', got {short_text(base)}")
        for name in ("each", "compare", "sweep"):
            check_table(table.get(name, {}), name)
        check_keys(table.get("each", {}), tuple(item.name for item in fields(JobSettings)))
        each = JobSettings(**table.get("each", {}))
        compare = CompareSettings.of(table["compare"], path.parent) if "compare" in table else None
        choices = [*_product(table.get("sweep", {})), *_single(table.get("points", []))]
        if not table.get("sweep") and not table.get("points"):
            raise ValueError("a sweep needs a table [sweep] or points [[points]], got neither")
    except ValueError as error:
        raise FileError(f"{str(path)!r}: {error}") from error
    base_path = path.parent / base
    settings = read_document(base_path)
    config_of(settings, base_path)  # an error of the base is not that of a point
    points: dict[str, Point] = {}
    configs: list[Config] = []
    foresights: list[Foresight] = []
    for values in choices:
        try:
            document = with_values(settings, values)
            key = key_of(document)
            if key not in points:
                config = config_of(document, base_path)
                _check_responses(config, compare)
                points[key] = Point(key, values, document)
                configs.append(config)
                foresights.append(foresee(config, each.threads))
        except ValueError as error:
            raise FileError(f"{str(path)!r}, {Point('', values, {})}: {error}") from error
    content = hashlib.sha256(path.read_bytes() + base_path.read_bytes()).hexdigest()
    points_of_study = tuple(points.values())
    return SweepStudy(path, base_path, points_of_study, tuple(configs), tuple(foresights), each, compare, content)


def _product(table):
    """Values by path, for all combinations of the lists of a table."""
    number = 1
    for path, values in table.items():
        _check_path(path)
        if not isinstance(values, list) or not values:
            quoted = f': write the path in quotes, "{path}.{next(iter(values))}"' if isinstance(values, dict) else ""
            raise ValueError(f"[sweep] {path} must be a list of values, got {short_text(values)}{quoted}")
        number *= len(values)
        if number > MAX_POINTS:
            raise ValueError(f"[sweep] must have at most {MAX_POINTS:,} combinations, got {number:,} or more")
    if table:
        for values in itertools.product(*table.values()):
            yield dict(zip(table, values, strict=True))


def _single(points):
    if not isinstance(points, list):
        raise ValueError(f"points must be tables [[points]], got {short_text(points)}")
    for values in points:
        check_table(values, "[[points]]")
        for path, value in values.items():
            _check_path(path)
            if path in ("tip", "simulation") and isinstance(value, Mapping):  # it would replace the complete table
                key = f"{path}.{next(iter(value), 'key')}"
                raise ValueError(f'[[points]] {path} must be a path in quotes, such as "{key}"')
        yield dict(values)


def _check_path(path):
    if path.split(".")[0] in _FIXED:
        raise ValueError(f"{path} is the same for all points: change it in the base")
    if not all(path.split(".")):
        raise ValueError(f"a path must be names joined by dots, such as 'tip.axis', got {short_text(path)}")


def _check_responses(config, compare):
    if compare is not None and not config.responses:
        raise ValueError("[compare] needs responses = true in [simulation]")


def with_values(document: dict[str, Any], values: Mapping[str, Any]) -> dict[str, Any]:
    """Return settings with other values.

    Parameters
    ----------
    document : dict
        Settings, tables in tables.
    values : mapping
        Values by path; a missing table is made, a value that is a table replaces the whole one.

    Returns
    -------
    dict
        A copy.

    Raises
    ------
    ValueError
        If a path leads through a value that is not a table.
    """
    document = copy.deepcopy(document)
    for path, value in values.items():
        table, *names = document, *path.split(".")
        for depth, name in enumerate(names[:-1], start=1):
            table = table.setdefault(name, {})
            if not isinstance(table, dict):
                raise ValueError(f"{path} leads through {'.'.join(names[:depth])}, which is {short_text(table)}")
        table[names[-1]] = copy.deepcopy(value)
    return document


def key_of(document: Mapping[str, Any]) -> str:
    """Key of a point: the first 12 digits of the SHA-256 of its settings as canonical JSON.

    The name of the output does not count, nor do the maps if the run has responses: they only select pictures then.
    Numbers that are equal have equal keys.
    """
    document = {name: value for name, value in document.items() if name != "output"}
    if document.get("simulation", {}).get("responses", True):
        document.pop("maps", None)
    return hashlib.sha256(json.dumps(_canonical(document), sort_keys=True).encode()).hexdigest()[:_DIGITS]


def _canonical(value):
    if isinstance(value, Mapping):
        return {key: _canonical(each) for key, each in value.items()}
    if isinstance(value, list):
        return [_canonical(each) for each in value]
    return int(value) if isinstance(value, float) and value.is_integer() else value
