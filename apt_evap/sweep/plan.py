"""The folder of a sweep: what is planned, and the state of each point."""

import csv
import io
import json
from collections.abc import Iterator, Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from apt_evap._common.files import FileError, check_path, read_small_file, replace_file
from apt_evap._common.types import AnyPath
from apt_evap._version import __version__
from apt_evap.config.toml_text import toml_text
from apt_evap.simulation.checkpoint import Checkpoint
from apt_evap.sweep.claims import Claim, Claims
from apt_evap.sweep.compare_settings import CompareSettings
from apt_evap.sweep.foresight import Foresight
from apt_evap.sweep.study_file import JobSettings, Point, SweepStudy, read_study

_FORMAT = "apt_evap sweep 1"
_PLAN, _TABLE, _POINTS = "plan.json", "points.csv", "points"
_MAX_BYTES = 1 << 30
SETTINGS, RUN, LOG = "settings.toml", "run.h5", "log.txt"
"""Files of a point."""
INTERRUPTED = (130, 143, -2)
"""Exit codes of a run that was interrupted: it has saved its ions, or had just started."""
RETRY = "retry"
"""Code of a claim that only makes the point open again."""


@dataclass(frozen=True)
class PointState:
    """State of a point.

    Parameters
    ----------
    name : {"done", "running", "failed", "open"}
        "open" also for a point that was interrupted or killed and will continue.
    claims : tuple of Claim
        All tries.
    message : str
        Reason of a failure, or who is at work.
    """

    name: str
    claims: tuple[Claim, ...]
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

    @property
    def keys(self) -> tuple[str, ...]:
        """Keys of the points."""
        return tuple(point.key for point in self.points)

    @property
    def paths(self) -> tuple[str, ...]:
        """Paths of the settings in which points differ."""
        return tuple(dict.fromkeys(path for point in self.points for path in point.values))

    def folder_of(self, key: str) -> Path:
        """Folder of a point."""
        return self.folder / _POINTS / key

    def value(self, point: Point, path: str) -> Any:
        """Value of a setting at a point; None if neither the point nor the base has it."""
        table: Any = point.document
        for name in path.split("."):
            if not isinstance(table, Mapping) or name not in table:
                return None
            table = table[name]
        return table

    def check_key(self, key: str) -> str:
        """Return the key of a point, given by its key or its number from 0; ValueError otherwise."""
        if key in self.keys:
            return key
        if key.isdigit() and int(key) < len(self.points):
            return self.points[int(key)].key
        raise ValueError(f"a point must be a key of {_TABLE} or a number below {len(self.points)}, got {key!r}")

    def state(self, key: str) -> PointState:
        """State of a point, from its files."""
        folder = self.folder_of(key)
        claims = tuple(Claims(folder).all())
        if not claims:
            return PointState("open", claims)
        last = claims[-1]
        if last.end is None:
            if Claims(folder).is_held(last):
                return PointState("running", claims, last.who)
        elif last.end["code"] == 0:
            return PointState("done" if (folder / RUN).exists() else "open", claims)
        elif last.end["code"] == RETRY or last.end["code"] in INTERRUPTED:
            return PointState("open", claims)
        elif last.end["code"] > 0:
            return PointState("failed", claims, last.end.get("message") or f"exit code {last.end['code']}")
        killed = self._killed_in_vain(folder, claims)
        if killed >= self.each.tries:
            return PointState("failed", claims, f"killed {killed} times without a new checkpoint")
        return PointState("open", claims)

    def _killed_in_vain(self, folder, claims):
        """Number of the last tries that were killed and added no ions."""
        ions, number = ions_of(folder), 0
        for claim in reversed(claims):
            was_killed = claim.end is None or (claim.end["code"] != RETRY and claim.end["code"] < 0)
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


def folder_of_study(path: AnyPath) -> Path:
    """Folder of the sweep of a study file: beside it, with its name without suffix; a folder is returned as it is."""
    path = check_path(path)
    if path.is_dir():
        return path.resolve()
    if not path.suffix:
        raise FileError(f"{str(path)!r} is neither a study file such as 'study.toml' nor the folder of a sweep")
    return path.resolve().with_suffix("")


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
    sweep = Sweep(folder, study.points, study.foresights, study.each, study.compare)
    try:
        for point in study.points:
            place = sweep.folder_of(point.key)
            place.mkdir(parents=True, exist_ok=True)
            _write(place / SETTINGS, f"# made from {study.base.name}: {point}\n{_settings_text(point)}")
    except OSError as error:
        raise FileError(f"cannot write {error.filename!r}: {error.strerror}") from error
    _write(folder / _TABLE, _table(sweep))
    _write(folder / _PLAN, json.dumps(_content(study), indent=1) + "\n")
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
        If the sweep is not planned, or the study file has changed since.
    """
    folder = folder_of_study(path)
    if not (folder / _PLAN).exists():
        raise FileError(f"{str(path)!r} is not planned yet: apt-evap sweep plan makes its folder {str(folder)!r}")
    try:
        content = json.loads(read_small_file(folder / _PLAN, _MAX_BYTES, "a plan"))
        if content["format"] != _FORMAT:
            raise ValueError(f"expected {_FORMAT!r}, got {content['format']!r}")
        sweep = Sweep(
            folder,
            tuple(Point(**point) for point in content["points"]),
            tuple(Foresight(**each) for each in content["foresights"]),
            JobSettings(**content["each"]),
            None if content["compare"] is None else CompareSettings(**content["compare"]),
        )
    except (ValueError, TypeError, KeyError, RecursionError) as error:
        raise FileError(f"{str(folder / _PLAN)!r} is not the plan of a sweep: {error}") from error
    path = Path(path)
    if path.is_file() and read_study(path).sha256 != content["sha256"]:
        raise FileError(f"{str(path)!r} or its base has changed since it was planned: run apt-evap sweep plan again")
    return sweep


def _content(study: SweepStudy) -> dict[str, Any]:
    return {
        "format": _FORMAT,
        "version": __version__,
        "study": study.path.name,
        "sha256": study.sha256,
        "base": study.base.name,
        "each": asdict(study.each),
        "compare": study.compare and study.compare.to_dict(),
        "points": [asdict(point) for point in study.points],
        "foresights": [each.to_dict() for each in study.foresights],
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


def _write(path, text):
    with replace_file(path) as file:
        file.write(text.encode())
