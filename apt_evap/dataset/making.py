"""Making of a data set from a study file: plan, runs, examples, description, checksums."""

import hashlib
import json
import re
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import scipy

from apt_evap._common.codec import from_plain, to_plain
from apt_evap._common.files import FileError, check_path, read_small_file, replace_file, sha256_of
from apt_evap._common.optional_imports import optional_import
from apt_evap._common.types import AnyPath
from apt_evap._version import __version__
from apt_evap.dataset.datasheet import datasheet
from apt_evap.dataset.examples import examples_of, joined
from apt_evap.dataset.fields import chosen_tables
from apt_evap.dataset.settings import SPLITS, DatasetSettings, read_instrument
from apt_evap.dataset.shards import Schema, file_names, key_in, key_of_shard, read_table, write_shard
from apt_evap.simulation.run import load
from apt_evap.sweep.planning import Sweep, plan, status
from apt_evap.sweep.point_folder import RUN
from apt_evap.sweep.sampling import drawn
from apt_evap.sweep.study_file import Point, SweepStudy, read_study
from apt_evap.sweep.working import work

FORMAT = "apt_evap dataset 1"
ABOUT, SHEET, SUMS = "dataset.json", "README.md", "SHA256SUMS"
"""Files of a data set beside those of its examples."""
_MAX_BYTES = 1 << 30
_SHARD = re.compile(rf"({'|'.join(SPLITS)})-\d{{4,}}(\.h5|\.\w+\.parquet)")
# Measured for runs of 60 to 2,000 ions with responses: 470 to 507 bytes per ion, 56 kB for the rest
_RUN_BYTES_PER_ION, _RUN_BYTES = 510, 6e4
_TEXT_BYTES, _FILE_BYTES = 4000, 40_000  # measured: 2.5 kB of texts in an example, 20 kB of HDF5 in an empty file
# Measured there: 2 s for 30 examples, with the import of the package; doubled as the times of the runs
_RECORDING = 6e-5  # seconds per ion and example


@dataclass(frozen=True)
class Shard:
    """Some runs whose examples share a file."""

    name: str
    split: str
    points: tuple[Point, ...]
    key: str


@dataclass(frozen=True, repr=False)
class PlannedSet:
    """A planned data set; made by `plan_set`.

    Parameters
    ----------
    study : SweepStudy
        The study.
    sweep : Sweep
        Its planned sweep, which makes the runs.
    settings : DatasetSettings
        What the examples contain.
    shards : tuple of Shard
        The files, with their runs.
    """

    study: SweepStudy
    sweep: Sweep
    settings: DatasetSettings
    shards: tuple[Shard, ...]

    def __repr__(self) -> str:
        return f"<PlannedSet: {len(self.sweep.points):,} runs, {self.examples:,} examples>"

    @property
    def examples(self) -> int:
        """Number of examples."""
        return len(self.sweep.points) * self.settings.per_run

    @property
    def schema(self) -> Schema:
        """Fields by table, dict."""
        return chosen_tables(self.settings.fields)

    @property
    def hours(self) -> float | None:
        """Time of one worker that is left, within a factor of 3 [h]; None if it is not known."""
        left = status(self.sweep)["hours_left"]
        ions = sum(cost.ions for cost in self.sweep.estimates)
        return None if left is None else left + _RECORDING * ions * self.settings.per_run / 3600

    @property
    def bytes(self) -> int:
        """Largest size of the data set: all ions within the field of view, before any compression [bytes]."""
        ions = sum(cost.ions for cost in self.sweep.estimates)
        rows = {"examples": 1, "poles": 24 * self.settings.families, "zone_lines": 13}  # as many as there can be
        rows["cap"] = 1 + ions // len(self.sweep.points) // 100
        sizes = {name: sum(field.bytes for field in fields) for name, fields in self.schema.items()}
        per_example = _TEXT_BYTES + sum(rows[name] * sizes[name] for name in rows if name in sizes)
        instrument = drawn(self.settings.instrument, np.random.default_rng(0), "instrument")
        efficiency = read_instrument(instrument).efficiency
        of_ions = int(efficiency * sizes["ions"] * ions * self.settings.per_run)
        return of_ions + per_example * self.examples + _FILE_BYTES * len(self.shards)

    @property
    def run_bytes(self) -> int:
        """Size of the runs in the folder of the sweep, which the finished data set does not need [bytes]."""
        estimates = self.sweep.estimates
        return int(_RUN_BYTES * len(estimates) + _RUN_BYTES_PER_ION * sum(cost.ions for cost in estimates))


def plan_set(path: AnyPath) -> PlannedSet:
    """Plan the data set of a study file: make the folder of its sweep. Nothing is run.

    Parameters
    ----------
    path : str or path-like
        The study file, with a table ``[dataset]``.

    Returns
    -------
    PlannedSet

    Raises
    ------
    FileError
        If the study is wrong, or a file cannot be written.
    """
    study = read_study(path)
    try:
        settings = from_plain(study.dataset, DatasetSettings, what="[dataset]")
        still = settings.emissions == ("Unperturbed",)
        if not still and not all(config.responses for config in study.configs):
            raise ValueError("emissions need responses = true in [simulation]")
        if settings.format == "parquet":
            optional_import("pyarrow", "a data set in Parquet")
    except (ValueError, ImportError) as error:
        raise FileError(f"{str(path)!r}, [dataset]: {error}") from error
    sweep = plan(path)
    return PlannedSet(study, sweep, settings, _shards(sweep.points, settings))


def _shards(points, settings):
    """Files of the data set: successive runs of a part share one, so that further points leave full files alone."""
    content = to_plain(settings)
    found = []
    for split in SPLITS:
        own = [point for point in points if split_of(point, settings) == split]
        for number, first in enumerate(range(0, len(own), settings.runs_per_file)):
            some = tuple(own[first : first + settings.runs_per_file])
            key = key_of_shard([FORMAT, __version__, content, split, [point.key for point in some]])
            found.append(Shard(f"{split}-{number:04}", split, some, key))
    return tuple(found)


def split_of(point: Point, settings: DatasetSettings) -> str:
    """Part of the data set to which a point belongs: by a hash of its specimen.

    Runs of one specimen are in one part, and further points do not move the earlier ones.
    """
    specimen = {name: value for name, value in point.document.items() if name in ("tip", "phases")}
    digest = hashlib.sha256(json.dumps(specimen, sort_keys=True).encode()).digest()
    place, end = int.from_bytes(digest[:6], "big") / (1 << 48), 0.0
    for name, fraction in zip(SPLITS, settings.split, strict=True):
        end += fraction
        if place < end:
            return name
    return next(name for name, fraction in reversed(list(zip(SPLITS, settings.split, strict=True))) if fraction)


def make(
    planned: PlannedSet,
    folder: AnyPath,
    *,
    workers: int = 1,
    without_failed: bool = False,
    note: Callable[[str], object] = lambda text: None,
) -> dict[str, Any]:
    r"""Make a data set, or finish one that was interrupted.

    Runs that are missing are made by the sweep. Files of examples that are complete are not written again. Equal
    studies give equal bytes, also after an interruption.

    Parameters
    ----------
    planned : PlannedSet
        The plan.
    folder : str or path-like
        Folder of the data set; it is made if necessary.
    workers : int
        Processes that run simulations.
    without_failed : bool
        Whether to leave out runs that have failed. The data sheet lists their settings.
    note : callable
        Called with a line of text on progress.

    Returns
    -------
    dict
        Content of ``dataset.json``.

    Raises
    ------
    FileError
        If a run has failed, a file is damaged, or cannot be written.

    Examples
    --------
    >>> from pathlib import Path
    >>> tip, ions = 'material = "Al"\napex_radius = "5 a"\nshank_length = "5 a"', "ions = 60"
    >>> _ = Path("base.toml").write_text(f"[tip]\n{tip}\n[simulation]\n{ions}\n")
    >>> study = 'base = "base.toml"\nsample = 1\n[sweep]\n"tip.axis" = "random"\n'
    >>> _ = Path("study.toml").write_text(f'{study}[dataset]\nemissions = ["Unperturbed", "RollUp:0.02"]\n')
    >>> planned = ae.dataset.plan_set("study.toml")
    >>> planned
    <PlannedSet: 1 runs, 2 examples>
    >>> content = ae.dataset.make(planned, "set")
    >>> example = ae.dataset.load("set")[1]
    >>> print(example.about["material"], example.about["emission"]["name"], example.ions["site"].shape[1])
    Al RollUp 3
    """
    folder, sweep = check_path(folder), planned.sweep
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise FileError(f"cannot write {str(folder)!r}: {error.strerror}") from error
    if (folder / SUMS).exists():
        _check_sums(folder, [name for shard in planned.shards for name in _files(planned, shard)])
    shards = planned.shards
    missing = [shard for shard in shards if _key_in(planned, folder, shard) != shard.key]
    keys = [point.key for shard in missing for point in shard.points]
    n_waiting = sum(sweep.state(key).name in ("waiting", "running") for key in keys)
    worked = {}
    if n_waiting:
        note(f"{n_waiting:,} of {len(sweep.points):,} runs are missing")
        worked = work(sweep, keys, workers if workers > 1 else None)
    states = {key: state for key in keys if (state := sweep.state(key)).name != "done"}
    failed = [key for key, state in states.items() if state.name == "failed"]
    if without_failed and len(failed) == len(states):
        points = tuple(point for point in sweep.points if point.key not in failed)
        shards = _shards(points, planned.settings)
        missing = [shard for shard in shards if _key_in(planned, folder, shard) != shard.key]
    elif states:
        key, state = next(iter(states.items()))
        message = state.message or (worked[key].message if key in worked else "")
        message = f", {message}" if message else ""
        remedy = "; --without-failed leaves them out" if len(failed) == len(states) else ""
        raise FileError(
            f"{len(states):,} of {len(sweep.points):,} runs are not done, such as {key}: {state.name}{message}{remedy}"
        )
    if missing:
        (folder / SUMS).unlink(missing_ok=True)  # those of files that are replaced now
    for number, shard in enumerate(missing, start=1):
        note(f"file {number:,} of {len(missing):,}: {shard.name}")
        examples = []
        for point in shard.points:
            examples += examples_of(_run(sweep, point.key), point, planned.settings, shard.split)
        tables = joined(examples, planned.settings)
        write_shard(folder, shard.name, tables, planned.schema, planned.settings.format, shard.key)
    return _finish(planned, folder, shards)


def _run(sweep, key):
    path = sweep.folder_of(key) / RUN
    run = load(path)
    if run.provenance.get("settings") != key:
        raise FileError(f"{str(path)!r} is the run of other settings than point {key}")
    return run


def _files(planned, shard):
    return sorted(set(file_names(shard.name, planned.schema, planned.settings.format).values()))


def _key_in(planned, folder, shard):
    return key_in(folder, shard.name, planned.schema, planned.settings.format)


def _finish(planned, folder, made):
    """Write the description, the studies and the checksums; remove files of examples that are not of the set."""
    study, settings = planned.study, planned.settings
    shards, included = [], {point.key for shard in made for point in shard.points}
    for shard in made:
        table = read_table(folder, shard.name, "examples", planned.schema, settings.format)
        names = _files(planned, shard)
        shards.append(
            {
                "name": shard.name,
                "split": shard.split,
                "files": {name: sha256_of(folder / name) for name in names},
                "runs": len(dict.fromkeys(table["run"])),
                "examples": len(table["run"]),
                "ions": int(np.sum(table["ions"])),
                "bytes": sum((folder / name).stat().st_size for name in names),
            }
        )
    content = {
        "format": FORMAT,
        "title": settings.title or study.path.stem,
        "dataset": to_plain(settings),
        "study": {study.path.name: study.path.read_text(), study.base.name: study.base.read_text()},
        "versions": _versions(settings),
        "left_out": {point.key: str(point) for point in planned.sweep.points if point.key not in included},
        "counts": {
            split: {
                name: sum(shard[name] for shard in shards if shard["split"] == split)
                for name in ("runs", "examples", "ions")
            }
            for split in SPLITS
        },
        "tables": {
            name: [
                {
                    "name": field.name,
                    "type": field.kind,
                    "shape": list(field.row),
                    "unit": field.unit,
                    "description": field.text,
                }
                for field in fields
            ]
            for name, fields in planned.schema.items()
        },
        "shards": shards,
    }
    _write(folder / ABOUT, json.dumps(content, indent=1, ensure_ascii=False) + "\n")
    _write(folder / SHEET, datasheet(content))
    listed = [name for shard in shards for name in shard["files"]]
    for path in sorted(folder.iterdir()):
        if _SHARD.fullmatch(path.name) and path.name not in listed:
            path.unlink()
    sums = {name: digest for shard in shards for name, digest in shard["files"].items()}
    sums |= {name: sha256_of(folder / name) for name in (ABOUT, SHEET)}
    _write(folder / SUMS, "".join(f"{digest}  {name}\n" for name, digest in sorted(sums.items())))
    return content


def _versions(settings):
    versions = {"apt_evap": __version__, "numpy": np.__version__, "scipy": scipy.__version__}
    if settings.format == "parquet":
        return versions | {"pyarrow": optional_import("pyarrow", "a data set in Parquet").__version__}
    return versions | {"h5py": h5py.__version__, "hdf5": h5py.version.hdf5_version}


def _write(path, text):
    with replace_file(path) as file:
        file.write(text.encode())


def read_about(folder: Path) -> dict[str, Any]:
    """Content of ``dataset.json``; FileError if it is not that of a data set."""
    path = folder / ABOUT
    try:
        content = json.loads(read_small_file(path, _MAX_BYTES, "the description of a data set"))
        if content["format"] != FORMAT:
            raise ValueError(f"expected {FORMAT!r}, got {content['format']!r:.60}")
    except FileError:
        raise
    except (ValueError, TypeError, KeyError) as error:
        raise FileError(f"{str(path)!r} is not the description of a data set: {error}") from error
    return content


def _sums(folder):
    text = read_small_file(folder / SUMS, _MAX_BYTES, "checksums").decode()
    return {name: digest for digest, _, name in (line.partition("  ") for line in text.splitlines())}


def _check_sums(folder, names=None):
    """Compare the SHA-256 of files; FileError for those that are damaged. Missing files count if no names are given."""
    sums = _sums(folder)
    for name in sums if names is None else [name for name in names if name in sums and (folder / name).exists()]:
        if sha256_of(folder / name) != sums[name]:
            remedy = "remove it, and make the data set again"
            raise FileError(f"{str(folder / name)!r} is damaged: its SHA-256 is not that of {SUMS}; {remedy}")
    return sums


def verify(folder: AnyPath) -> dict[str, Any]:
    """Verify a finished data set: the checksums of all its files.

    Parameters
    ----------
    folder : str or path-like
        The data set.

    Returns
    -------
    dict
        Content of ``dataset.json``.

    Raises
    ------
    FileError
        If a file is missing or damaged.
    """
    folder = check_path(folder)
    content = read_about(folder)
    sums = _check_sums(folder)
    for shard in content["shards"]:
        for name in shard["files"]:
            if name not in sums:
                raise FileError(f"{str(folder / SUMS)!r} has no checksum of {name}")
    return content
