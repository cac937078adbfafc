"""The study file of a sweep: common settings, and the values that are combined."""

import copy
import hashlib
import itertools
import json
import os
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from apt_evap._common.codec import count, from_plain, number, settings
from apt_evap._common.files import FileError, check_path, sha256_of
from apt_evap._common.types import AnyPath
from apt_evap._common.validation import check_count, check_seed, short_text
from apt_evap.simulation.config.cost_estimate import CostEstimate, estimate_cost
from apt_evap.simulation.config.simulation_file import config_of, key_of, read_document
from apt_evap.simulation.config.simulation_settings import Config
from apt_evap.simulation.config.tables import check_keys, check_table
from apt_evap.studies.sweep.compare_settings import CompareSettings
from apt_evap.studies.sweep.sampling import AXIS, RandomAxis, option_of, samples

MAX_POINTS = 100_000  # a larger product is a typing error
POINTS = "points"
"""Folder of the points in that of a sweep."""
_FIXED = ("output", "maps")  # not settings of the simulation


@settings
class JobSettings:
    """How each point is run; not part of its settings."""

    threads: int = count(
        "Threads of a run. Two threads are 1.65 to 1.81 times as fast as one: while memory lasts, many runs of one "
        "thread finish earlier.",
        default=1,
        at_least=1,
    )
    checkpoint: float = number("Time between two checkpoints.", default=10.0, at_least=0, unit="min")


@dataclass(frozen=True)
class Point:
    """One simulation of a sweep.

    Parameters
    ----------
    values : dict
        Settings in which this point differs from the base: values by path, such as ``{"tip.axis": [1, 1, 1]}``.
    """

    key: str
    values: dict
    document: dict
    estimate: CostEstimate

    def __str__(self):
        return _text_of(self.values)


def _text_of(values):
    """Settings in which a point differs from the base, as text."""
    return ", ".join(f"{path} = {json.dumps(value, default=str)}" for path, value in values.items()) or "the base"


@dataclass(frozen=True)
class SweepStudy:
    """Content of a study file; made by `read_study`.

    Parameters
    ----------
    dataset : dict
        The table ``[dataset]``, for `studies.make_dataset`.
    """

    path: Path
    base: Path
    points: tuple[Point, ...]
    configs: tuple[Config, ...]
    job: JobSettings
    compare: CompareSettings | None
    sha256: str
    dataset: dict


def folder_of_study(path: AnyPath) -> Path:
    """Folder of the sweep of a study file: beside it, with its name without suffix; a folder is returned as it is."""
    path = check_path(path)
    if not path.is_dir() and not path.suffix:
        raise FileError(f"{str(path)!r} is neither a study file such as 'study.toml' nor the folder of a sweep")
    return path.resolve() if path.is_dir() else path.resolve().with_suffix("")


def read_study(path: AnyPath) -> SweepStudy:
    """Read a study file.

    ``base`` is the file of settings that all points share (of `apt-evap run`, relative to the study file). ``[sweep]``
    contains lists of values by path; all combinations are points. Each ``[[points]]`` is one more point. Paths are
    quoted: ``"tip.axis" = [[0, 0, 1], [1, 1, 1]]``. ``[each]`` contains the fields of `JobSettings`, ``[compare]`` a
    measured file and the parameters of `fit_tips`, ``[dataset]`` the fields of `DatasetSettings`.

    With ``sample = 300``, values of ``[sweep]`` can also be ranges: ``{ uniform = [20, 60] }``, ``{ log_uniform =
    [1e-3, 0.1] }``, ``{ integer = [1, 6] }``, ``{ choice = ["Ni", "Al"] }``, and "random" for the axis. Samples are
    Sobol' points, scrambled by ``seed``, and have seeds of their own. Each sample is combined with all combinations of
    the lists.
    """
    path = Path(path)
    table = read_document(path)
    try:
        known = ("base", "sample", "seed", "each", "compare", "dataset", "sweep", "points")
        check_keys(table, known, ("base",))
        base = table["base"]
        if not isinstance(base, str) or not base:
            raise ValueError(f"base must be a file name such as 'ni111.toml', got {short_text(base)}")
        for name in ("each", "compare", "dataset", "sweep"):
            check_table(table.get(name, {}), name)
        job = from_plain(table.get("each", {}), JobSettings, what="[each]")
        compare = CompareSettings.of(table["compare"], path.parent) if "compare" in table else None
        if compare is not None and not Path(compare.measured).is_file():
            raise ValueError(f"[compare] measured must be an existing file, got {short_text(compare.measured)}")
        choices = [*_product(table), *_single(table.get("points", []))]
        if not choices:
            raise ValueError("a sweep needs a table [sweep] or points [[points]], got neither")
    except ValueError as error:
        raise FileError(f"{str(path)!r}: {error}") from error
    base_path = path.parent / base
    settings = read_document(base_path)
    config_of(settings, base_path)  # an error of the base is not that of a point
    points: dict[str, Point] = {}
    configs: list[Config] = []
    place, digests = folder_of_study(path) / POINTS / "point", {}
    for values in choices:
        try:
            values = _fitting(values, settings, base_path)
            document = with_values(settings, values)
            config = config_of(document, base_path)
            if "path" in config.tip:
                document["tip"] = _specimen_table(document["tip"], config.tip["path"], place, digests)
            key = key_of(document)
            if key not in points:
                if compare is not None and not config.responses:
                    raise ValueError("[compare] needs responses = true in [simulation]")
                points[key] = Point(key, values, document, estimate_cost(config, job.threads))
                configs.append(config)
        except ValueError as error:
            raise FileError(f"{str(path)!r}, {_text_of(values)}: {error}") from error
    content = path.read_bytes() + base_path.read_bytes() + "".join(digests.values()).encode()
    sha256 = hashlib.sha256(content).hexdigest()
    dataset = table.get("dataset", {})
    return SweepStudy(path, base_path, tuple(points.values()), tuple(configs), job, compare, sha256, dataset)


def _fitting(values, settings, path):
    """Values of a point that fit the specimen: an axis of the crystal, and only seeds that the specimen takes."""
    table = settings["tip"]
    if "file" in table:
        values = {key: value for key, value in values.items() if key not in ("tip.seed", "tip.offset_seed")}
    elif "origin" in table or "tip.origin" in values:
        values = {key: value for key, value in values.items() if key != "tip.offset_seed"}
    if isinstance(values.get(AXIS), RandomAxis):
        tip = config_of(with_values(settings, values | {AXIS: [0, 0, 1]}), path).tip
        if "path" in tip:
            raise ValueError(f"{AXIS} must be that of a material, but the specimen is a file")
        values = values | {AXIS: values[AXIS].of(tip["phases"][0].material if "phases" in tip else tip["material"])}
    return values


def _specimen_table(table, path, place, digests):
    """The table [tip] of a specimen from a file, for a folder beside `place`: with its SHA-256."""
    path = path.resolve()
    if path not in digests:
        digests[path] = sha256_of(path)
    return {"sha256": digests[path]} | table | {"file": os.path.relpath(path, place)}


def _product(table):
    """Values by path, for all combinations of the lists of a study, with each of its samples."""
    sweep, lists, options = table.get("sweep", {}), {}, {}
    is_sampled = "sample" in table
    number = check_count(table["sample"], "sample", at_least=1) if is_sampled else 1
    seed = check_seed(table.get("seed", 0), "seed")
    if "seed" in table and not is_sampled:
        raise ValueError(f"seed is that of samples, and needs sample = 300, got {seed} alone")
    for path, values in sweep.items():
        check_setting_path(path)
        if isinstance(values, list) and values:
            lists[path] = values
            number *= len(values)
        elif is_sampled and not isinstance(values, list):
            options[path] = option_of(values, path)
        else:
            quoted = ""
            if isinstance(values, dict) and values:
                name = next(iter(values))
                quoted = f': a range needs sample = 300; otherwise write the path in quotes, "{path}.{name}"'
            raise ValueError(f"[sweep] {path} must be a list of values, got {short_text(values)}{quoted}")
    if number > MAX_POINTS:
        raise ValueError(f"a sweep must have at most {MAX_POINTS:,} points, got {number:,}")
    if not (sweep or is_sampled):
        return
    for sample in samples(options, table["sample"], seed) if is_sampled else [{}]:
        for values in itertools.product(*lists.values()):
            yield sample | dict(zip(lists, values, strict=True))


def _single(points):
    if not isinstance(points, list):
        raise ValueError(f"points must be tables [[points]], got {short_text(points)}")
    for values in points:
        check_table(values, "[[points]]")
        for path, value in values.items():
            check_setting_path(path)
            if path in ("tip", "simulation") and isinstance(value, Mapping):  # it would replace the complete table
                key = f"{path}.{next(iter(value), 'key')}"
                raise ValueError(f'[[points]] {path} must be a path in quotes, such as "{key}"')
        yield dict(values)


def check_setting_path(path: str) -> None:
    """Raise a ValueError if a path is not that of a setting that points can have of their own."""
    if path.split(".")[0] in _FIXED:
        raise ValueError(f"{path} is the same for all points: change it in the base")
    if not all(path.split(".")):
        raise ValueError(f"a path must be names joined by dots, such as 'tip.axis', got {short_text(path)}")


def with_values(document: dict[str, Any], values: Mapping[str, Any]) -> dict[str, Any]:
    """Return settings with other values."""
    document = copy.deepcopy(document)
    for path, value in values.items():
        table, *names = document, *path.split(".")
        for depth, name in enumerate(names[:-1], start=1):
            table = table[_number(name, table)] if isinstance(table, list) else table.setdefault(name, {})
            if not isinstance(table, dict | list):
                raise ValueError(f"{path} leads through {'.'.join(names[:depth])}, which is {short_text(table)}")
        last: Any = _number(names[-1], table) if isinstance(table, list) else names[-1]
        table[last] = copy.deepcopy(value)
    return document


def value_at(document: Mapping[str, Any], path: str) -> Any:
    """Value of settings at a path, None if it is missing."""
    value: Any = document
    for name in path.split("."):
        if isinstance(value, list) and name.isdecimal() and int(name) < len(value):
            value = value[int(name)]
        elif isinstance(value, Mapping) and name in value:
            value = value[name]
        else:
            return None
    return value


def _number(name, entries):
    """Number of an entry of a list."""
    if not (name.isdecimal() and int(name) < len(entries)):
        raise ValueError(f"{short_text(name)} in a path must be the number of an entry, from 0 to {len(entries) - 1}")
    return int(name)
