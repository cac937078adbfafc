"""Making of a data set from a study file: plan, runs, examples, description, checksums."""

import os
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import scipy

from apt_evap._common.codec import from_plain, to_plain
from apt_evap._common.files import FileError, check_path, is_unfinished, sha256_of
from apt_evap._common.kept import check_made_from, digest_of
from apt_evap._common.optional_imports import optional_import
from apt_evap._common.types import AnyPath
from apt_evap._common.version import __version__
from apt_evap.simulation.locks import FileLock
from apt_evap.simulation.run import load
from apt_evap.studies.dataset.dataset_examples import examples_of, joined
from apt_evap.studies.dataset.dataset_settings import MOST_EXAMPLES, SPLITS, DatasetSettings, read_instrument
from apt_evap.studies.dataset.fields import chosen_tables
from apt_evap.studies.dataset.set_description import (
    ABOUT,
    FORMAT,
    SHEET,
    SUMS,
    check_sha256,
    counts_of,
    finish,
    is_complete,
    is_finished,
    made_from,
    read_about,
    read_finished,
    tables_of,
    write_about,
)
from apt_evap.studies.dataset.shards import Schema, file_names, write_shard
from apt_evap.studies.sweep.planning import Sweep, make_plan, sweep_status
from apt_evap.studies.sweep.point_folder import RUN
from apt_evap.studies.sweep.sampling import drawn
from apt_evap.studies.sweep.study_file import Point, SweepStudy, read_study
from apt_evap.studies.sweep.working import run_sweep

LOCK = ".lock"
"""Lock of the folder of a data set, which exists while a process writes into it."""
_WAIT = 2.0  # seconds between two looks at runs that another process makes
# Measured for runs of 60 to 7,000 ions with responses: 620 to 670 bytes per ion, 120 to 160 kB for the rest
_RUN_BYTES_PER_ION, _RUN_BYTES = 670, 1.6e5
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
    """A planned data set; made by `plan_dataset`."""

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
        left = sweep_status(self.sweep)["hours_left"]
        return None if left is None else left + _RECORDING * self._ions * self.settings.per_run / 3600

    @property
    def bytes(self) -> int:
        """Largest size of the data set: all ions within the field of view, before any compression [bytes]."""
        ions = self._ions
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
        return int(_RUN_BYTES * len(self.sweep.points) + _RUN_BYTES_PER_ION * self._ions)

    @property
    def _ions(self) -> int:
        """Planned number of ions of all runs."""
        return sum(point.estimate.ions for point in self.sweep.points)


def plan_dataset(path: AnyPath) -> PlannedSet:
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
        examples = len(study.points) * settings.per_run
        if examples > MOST_EXAMPLES:
            raise ValueError(f"a data set must have at most {MOST_EXAMPLES:,} examples, got {examples:,}")
    except (ValueError, ImportError) as error:
        raise FileError(f"{str(path)!r}, [dataset]: {error}") from error
    sweep = make_plan(study)
    return PlannedSet(study, sweep, settings, _shards(sweep.points, settings))


def _shards(points, settings):
    """Files of the data set: successive runs of a part share one, so that further points leave full files alone."""
    content = made_from({"dataset": to_plain(settings), "versions": {"apt_evap": __version__}})
    found = []
    for split in SPLITS:
        own = [point for point in points if split_of(point, settings) == split]
        for number, first in enumerate(range(0, len(own), settings.runs_per_file)):
            some = tuple(own[first : first + settings.runs_per_file])
            key = digest_of([FORMAT, content, split, [point.key for point in some]])
            found.append(Shard(f"{split}-{number:04}", split, some, key))
    return tuple(found)


def split_of(point: Point, settings: DatasetSettings) -> str:
    """Part of the data set to which a point belongs: by a hash of its specimen.

    Runs of one specimen are in one part, and further points do not move the earlier ones.
    """
    specimen = {name: value for name, value in point.document.items() if name in ("tip", "phases")}
    place, end = int(digest_of(specimen)[:12], 16) / (1 << 48), 0.0
    for name, fraction in zip(SPLITS, settings.split, strict=True):
        end += fraction
        if place < end:
            return name
    return next(name for name, fraction in reversed(list(zip(SPLITS, settings.split, strict=True))) if fraction)


def make_dataset(
    planned: PlannedSet,
    folder: AnyPath,
    *,
    workers: int = 1,
    without_failed: bool = False,
    note: Callable[[str], object] = lambda text: None,
) -> dict[str, Any]:
    r"""Make a data set, or finish one that was interrupted.

    Runs that are missing are made by the sweep, also those that a full disk or another error of the system has ended.
    Files of examples that are complete are not written again. Equal studies give equal bytes, also after an
    interruption, or if two processes make the set.

    Parameters
    ----------
    planned : PlannedSet
        The plan.
    folder : str or path-like
        Folder of the data set: new, empty, or that of a data set of the same study or of fewer points of it.
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
        If the folder contains something else, a run has failed, a file is damaged, or cannot be written.

    Examples
    --------
    >>> from pathlib import Path
    >>> tip, ions = 'material = "Al"\napex_radius = "5 a"\nshank_length = "5 a"', "ions = 60"
    >>> _ = Path("base.toml").write_text(f"[tip]\n{tip}\n[simulation]\n{ions}\n")
    >>> study = 'base = "base.toml"\nsample = 1\n[sweep]\n"tip.axis" = "random"\n'
    >>> _ = Path("study.toml").write_text(f'{study}[dataset]\nemissions = ["Unperturbed", "RollUp:0.02"]\n')
    >>> planned = ae.studies.plan_dataset("study.toml")
    >>> planned
    <PlannedSet: 1 runs, 2 examples>
    >>> content = ae.studies.make_dataset(planned, "set")
    >>> example = ae.load_dataset("set")[1]
    >>> print(example.about["material"], example.about["emission"]["name"], example.ions["site"].shape[1])
    Al RollUp 3
    """
    folder, sweep = check_path(folder), planned.sweep
    with _alone(folder, note):
        content = _begin(planned, folder)
    shards = planned.shards
    keys = [point.key for shard in _missing(shards, content, folder) for point in shard.points]
    states = _run_missing(sweep, keys, workers, note)
    failed = [key for key, state in states.items() if state.name == "failed"]
    if without_failed and len(failed) == len(states):
        shards = _shards([point for point in sweep.points if point.key not in failed], planned.settings)
    elif states:
        key, state = next(iter(states.items()))
        message = f", {state.message}" if state.message else ""
        remedy = "; --without-failed leaves them out, apt-evap sweep work --retry tries them again"
        raise FileError(
            f"{len(states):,} of {len(sweep.points):,} runs are not done, such as {key}: {state.name}{message}"
            f"{remedy if len(failed) == len(states) else ''}"
        )
    with _alone(folder, note):
        content = _begin(planned, folder)  # again: another process may have worked on it
        _record(planned, folder, shards, content, note)
        return read_finished(folder)


def _begin(planned, folder):
    """Description of the data set in a folder, made if the folder is empty; FileError if it is not that of this study.

    It names all files that may be replaced. Nothing else in the folder is.
    """
    try:
        names = [name for name in os.listdir(folder) if not is_unfinished(name) and name != LOCK]
    except OSError as error:
        raise FileError(f"cannot read {str(folder)!r}: {error.strerror}") from error
    if not names:
        content = _content(planned, [_entry(planned, shard) for shard in planned.shards])
        write_about(folder, content)
        return content
    remedy = "give another folder with -o, or remove it"
    if ABOUT not in names:
        raise FileError(f"{str(folder)!r} contains {min(names)!r} and is not a data set: {remedy}")
    content = read_finished(folder, (SHEET,) if SHEET in names else ()) if SUMS in names else read_about(folder)
    check_made_from(folder, made_from(content), made_from(_content(planned)), remedy)
    known = set(planned.sweep.keys)
    if lost := [key for key in content["points"] if key not in known]:
        raise FileError(
            f"{str(folder)!r} contains {len(lost):,} runs that this study does not have, such as {lost[0]}: {remedy}"
        )
    listed = {ABOUT, SHEET, SUMS, *(name for shard in content["shards"] for name in shard["files"])}
    for name in {*listed, *(name for shard in planned.shards for name in _files(planned, shard))}.intersection(names):
        if name not in listed or (folder / name).is_symlink():
            raise FileError(f"{str(folder / name)!r} is a link, or not a file of the data set: {remedy}")
    return content


def _missing(shards, content, folder):
    """Shards that are not complete; FileError if a file of a complete one has changed."""
    complete = {(shard["name"], shard["key"]): shard["files"] for shard in content["shards"] if is_complete(shard)}
    missing = []
    for shard in shards:
        files = complete.get((shard.name, shard.key))
        if files is None or not all(os.path.lexists(folder / name) for name in files):
            missing.append(shard)
            continue
        for name, digest in files.items():
            check_sha256(folder / name, digest, f"that of {ABOUT}")
    return missing


def _run_missing(sweep, keys, workers, note):
    """Make runs that are missing, or wait for those that another process makes; states of those that are not done."""
    worked: dict[str, Any] = {}
    is_waiting = False
    while True:
        states = {key: state for key in keys if (state := sweep.state(key)).name != "done"}
        new = [key for key, state in states.items() if state.name == "waiting" and key not in worked]
        n_running = sum(state.name == "running" for state in states.values())
        if new:
            note(f"{len(states):,} of {len(sweep.points):,} runs are missing")
            worked |= dict.fromkeys(new) | run_sweep(sweep, new, workers if workers > 1 else None)
            # those that another process had begun are tried again if it is killed
            worked = {key: state for key, state in worked.items() if state is None or state.name != "running"}
        elif n_running:
            if not is_waiting:
                note(f"waiting for {n_running:,} runs of another process")
            is_waiting = True
            time.sleep(_WAIT)
        else:
            # the message of an error of the system is that of this call
            return {key: worked.get(key) or state for key, state in states.items()}


@contextmanager
def _alone(folder: Path, note: Callable[[str], object]) -> Iterator[None]:
    """Make a folder, and wait until no other process on this machine writes into it."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise FileError(f"cannot write {str(folder)!r}: {error.strerror}") from error
    lock = FileLock(folder / LOCK, str(folder), wait=lambda: note(f"waiting for another process that writes {folder}"))
    try:
        yield
    finally:
        lock.release()


def _record(planned, folder, shards, content, note):
    """Write the files of examples that are missing, the description and the checksums, unless all are there.

    The description is written first, so that every file that is written after it is known as one of the data set, and
    again after each of them, with its SHA-256.
    """
    missing = _missing(shards, content, folder)
    complete = {(shard["name"], shard["key"]): shard for shard in content["shards"]}
    entries = [_entry(planned, shard) if shard in missing else complete[shard.name, shard.key] for shard in shards]
    included = {point.key for shard in shards for point in shard.points}
    left_out = {point.key: str(point) for point in planned.sweep.points if point.key not in included}
    new = _content(planned, entries, left_out)
    if is_finished(folder) and new | {"versions": content["versions"]} == content:
        return
    with suppress(FileNotFoundError):
        (folder / SUMS).unlink()  # those of files that are replaced now
    write_about(folder, new)
    for number, shard in enumerate(missing, start=1):
        note(f"file {number:,} of {len(missing):,}: {shard.name}")
        examples = []
        for point in shard.points:
            examples += examples_of(_run(planned.sweep, point.key), point, planned.settings, shard.split)
        tables = joined(examples, planned.settings)
        write_shard(folder, shard.name, tables, planned.schema, planned.settings.format)
        entries[shards.index(shard)] = _entry(planned, shard, folder, tables["examples"])
        new = _content(planned, entries, left_out)
        write_about(folder, new)
    finish(folder, new)


def _run(sweep, key):
    path = sweep.folder_of(key) / RUN
    run = load(path)
    if run.provenance.get("settings") != key:
        raise FileError(f"{str(path)!r} is the run of other settings than point {key}")
    return run


def _files(planned, shard):
    return sorted(set(file_names(shard.name, planned.schema, planned.settings.format).values()))


def _entry(planned, shard, folder=None, examples=None):
    """Description of a shard; without its folder and table of examples, of one that is not written yet."""
    names = _files(planned, shard)
    return {
        "name": shard.name,
        "split": shard.split,
        "key": shard.key,
        "files": {name: None if folder is None else sha256_of(folder / name) for name in names},
        "runs": 0 if examples is None else len(dict.fromkeys(examples["run"])),
        "examples": 0 if examples is None else len(examples["run"]),
        "ions": 0 if examples is None else int(np.sum(examples["ions"])),
        "bytes": 0 if folder is None else sum((folder / name).stat().st_size for name in names),
    }


def _content(planned, shards=(), left_out=None):
    """Content of ``dataset.json`` with these descriptions of shards, and of runs that are left out."""
    study, settings = planned.study, planned.settings
    return {
        "format": FORMAT,
        "title": settings.title or study.path.stem,
        "dataset": to_plain(settings),
        "points": list(planned.sweep.keys),
        "study": {path.name: path.read_text("utf-8-sig") for path in (study.path, study.base)},
        "versions": _versions(settings),
        "left_out": left_out or {},
        "counts": counts_of(shards),
        "tables": tables_of(planned.schema),
        "shards": list(shards),
    }


def _versions(settings):
    versions = {"apt_evap": __version__, "numpy": np.__version__, "scipy": scipy.__version__}
    if settings.format == "parquet":
        return versions | {"pyarrow": optional_import("pyarrow", "a data set in Parquet").__version__}
    return versions | {"h5py": h5py.__version__, "hdf5": h5py.version.hdf5_version}
