"""Jobs of a batch system: scripts of job arrays, and their submission."""

import math
import re
import shlex
import subprocess
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from apt_evap._common.files import FileError, read_small_file
from apt_evap._common.types import AnyPath
from apt_evap._common.validation import check_choice
from apt_evap.sweep.files import unlinked, write
from apt_evap.sweep.planning import Sweep

_MARGIN = 1.3  # of the memory: its foresight is within 30 %
_LEAST_MEMORY = 300  # [MB]
_UNKNOWN_MEMORY = 4_000  # [MB], of specimens whose size is not foreseen
_DEFAULT_HOURS = 24.0
_MAX_ARRAY = 1_000  # tasks of an array, where the system does not tell: the default of Slurm is 1,001
_MAX_BYTES = 1 << 20
_JOBS = "jobs"

SLURM = """\
#!/bin/bash
#SBATCH --job-name=@NAME@
#SBATCH --array=0-@LAST@@PARALLEL@
#SBATCH --cpus-per-task=@THREADS@
#SBATCH --mem=@MEMORY@M
#SBATCH --time=@TIME@
#SBATCH --signal=B:TERM@120
#SBATCH --requeue
#SBATCH --open-mode=append
#SBATCH --output=@LOG@
@OPTIONS@
KEYS=(@KEYS@)
exec @COMMAND@ --point "${KEYS[$SLURM_ARRAY_TASK_ID]}"
"""
PBS = """\
#!/bin/bash
#PBS -N @NAME@
@ARRAY@
#PBS -l select=1:ncpus=@THREADS@:mem=@MEMORY@mb
#PBS -l walltime=@TIME@
#PBS -r y
#PBS -j oe
#PBS -o @LOG@
@OPTIONS@
KEYS=(@KEYS@)
exec @COMMAND@ --point "${KEYS[${PBS_ARRAY_INDEX:-0}]}"
"""


@dataclass(frozen=True)
class BatchSystem:
    """A batch system.

    Parameters
    ----------
    template : str
        Script with the placeholders of `scripts`.
    submit : tuple of str
        Command that submits a script; the name of the script is added.
    directive : str
        Beginning of a line with an option.
    log : str
        Log files of the tasks, with "{}" for their folder.
    forbidden : str
        Regular expression of characters that the name of the folder of a log cannot contain.
    """

    template: str
    submit: tuple[str, ...]
    directive: str
    log: str
    forbidden: str


SYSTEMS = {
    # Slurm reads quotes as a shell does, but no symbols such as %A after a backslash (seen with 22.05)
    "slurm": BatchSystem(SLURM, ("sbatch", "--parsable"), "#SBATCH", '"{}/%A_%a.log"', r"[\"\\]"),
    "pbs": BatchSystem(PBS, ("qsub",), "#PBS", "{}/", r"[^\w/.+-]"),
}


def scripts(
    sweep: Sweep,
    keys: Sequence[str],
    scheduler: str = "slurm",
    *,
    template: AnyPath | None = None,
    options: Sequence[str] = (),
    at_once: int | None = None,
    largest: int = _MAX_ARRAY,
) -> list[str]:
    """Scripts of job arrays with one task for each point.

    Placeholders of a template: ``@KEYS@`` (the keys of the points, separated by spaces), ``@COUNT@``, ``@LAST@`` (their
    number less 1), ``@COMMAND@`` (to which ``--point KEY`` is added), ``@THREADS@``, ``@MEMORY@`` [MB], ``@TIME@``
    (hours:minutes:seconds), ``@HOURS@``, ``@NAME@``, ``@FOLDER@`` (quoted for the shell if necessary), ``@LOG@`` (of
    the tasks, for an option of the batch system), ``@OPTIONS@``, ``@PARALLEL@`` (%N for Slurm), ``@ARRAY@`` (the line
    of an array for PBS).

    Parameters
    ----------
    sweep : Sweep
        The sweep.
    keys : sequence of str
        Keys of the points.
    scheduler : {"slurm", "pbs"}
        Batch system.
    template : str or path-like, optional
        File with a script; by default the one of the batch system.
    options : sequence of str
        Options of the batch system, such as "--partition=short".
    at_once : int, optional
        Largest number of tasks of an array that run at the same time.
    largest : int
        Largest number of tasks of an array; more points give several scripts.

    Returns
    -------
    list of str

    Raises
    ------
    ValueError
        If the template cannot be read or has an unknown placeholder, or the batch system has no quotes for a character
        in the name of the folder.
    """
    system = SYSTEMS[check_choice(scheduler, "scheduler", SYSTEMS)]
    text = system.template
    if template is not None:
        text = read_small_file(template, _MAX_BYTES, "a script").decode(errors="replace")
    texts = []
    for first in range(0, len(keys), largest):
        values = _values(sweep, keys[first : first + largest], system, options, at_once)
        parts = re.split(r"@([A-Z]+)@", text)  # not one after the other: a value may contain the name of a placeholder
        if unknown := sorted(set(parts[1::2]) - set(values)):
            known = ", ".join(f"@{name}@" for name in values)
            raise ValueError(f"{str(template)!r} has the unknown placeholder @{unknown[0]}@; known are {known}")
        parts[1::2] = [values[name] for name in parts[1::2]]
        filled = "".join(parts)
        texts.append("\n".join(line for line in filled.split("\n") if line) + "\n")
    return texts


def _values(sweep, keys, system, options, at_once):
    needs = dict(zip(sweep.keys, sweep.foresights, strict=True))
    memory = [needs[key].memory for key in keys]
    megabytes = [_UNKNOWN_MEMORY if each is None else _MARGIN * each / 1e6 for each in memory]
    hours = sweep.each.hours or _DEFAULT_HOURS
    seconds = round(3600 * hours)
    last = len(keys) - 1
    logs = str(sweep.folder / _JOBS)
    if wrong := re.search(system.forbidden, logs):
        raise ValueError(
            f"the folder of a sweep must have no {wrong[0]!r} in its name for this batch system, got {logs!r}"
        )
    return {
        "KEYS": " ".join(keys),
        "COUNT": str(len(keys)),
        "LAST": str(last),
        "COMMAND": shlex.join(
            [sys.executable, "-P", "-m", "apt_evap.cli", "sweep", "work", str(sweep.folder), "--quiet"]
        ),
        "THREADS": str(sweep.each.threads),
        "MEMORY": str(math.ceil(max(_LEAST_MEMORY, *megabytes))),
        "TIME": f"{seconds // 3600:02d}:{seconds // 60 % 60:02d}:{seconds % 60:02d}",
        "HOURS": f"{hours:g}",
        "NAME": re.sub(r"[^A-Za-z0-9_.-]", "_", sweep.folder.name)[:15],  # PBS takes at most 15 characters
        "FOLDER": shlex.quote(str(sweep.folder)),
        "LOG": system.log.format(logs.replace("%", "%%")),
        "OPTIONS": "\n".join(f"{system.directive} {option}" for option in options),
        "PARALLEL": "" if at_once is None else f"%{at_once}",
        "ARRAY": f"#PBS -J 0-{last}" if last else "",  # an array of one task is refused
    }


def submit(sweep: Sweep, texts: Sequence[str], scheduler: str, command: str | None = None) -> list[tuple[Path, str]]:
    """Write scripts to the folder ``jobs`` of a sweep, and submit them.

    Parameters
    ----------
    sweep : Sweep
        The sweep.
    texts : sequence of str
        Result of `scripts`.
    scheduler : str
        Batch system.
    command : str, optional
        Command that submits a script, for example "bsub -q short"; by default that of the batch system.

    Returns
    -------
    list of tuple
        File of each script, and the answer of the batch system.

    Raises
    ------
    FileError
        If a file cannot be written, or the batch system refuses a script.
    """
    words = SYSTEMS[scheduler].submit if command is None else tuple(shlex.split(command))
    folder = unlinked(sweep.folder / _JOBS)
    folder.mkdir(exist_ok=True)
    answers = []
    for text in texts:
        numbers = [int(path.stem) for path in folder.glob("*.sh") if path.stem.isdecimal()]
        path = folder / f"{max(numbers, default=0) + 1:04d}.sh"
        write(path, text)
        try:
            done = subprocess.run([*words, str(path)], capture_output=True, text=True, check=False)
        except OSError as error:
            raise FileError(f"cannot start {words[0]!r}: {error.strerror}; the script is {str(path)!r}") from error
        if done.returncode:
            said = " ".join((done.stderr or done.stdout).split())
            raise FileError(f"{words[0]} refused {str(path)!r} (exit code {done.returncode}): {said}")
        answers.append((path, done.stdout.strip()))
    return answers


def largest_array(scheduler: str) -> int:
    """Largest number of tasks of an array that Slurm allows; 1,000 where this is not known."""
    if scheduler == "slurm":
        try:
            done = subprocess.run(["scontrol", "show", "config"], capture_output=True, text=True, check=False)
        except OSError:
            return _MAX_ARRAY
        if match := re.search(r"^MaxArraySize\s*=\s*(\d+)", done.stdout, re.MULTILINE):
            return max(1, int(match[1]) - 1)  # indices are below this number
    return _MAX_ARRAY
