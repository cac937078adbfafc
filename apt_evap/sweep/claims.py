"""Claims: which process works on a point, on any file system, and the journal of all tries.

The folder ``claims`` of a point contains the files 0001.json, 0002.json, ... The one with the highest number is valid.
A process claims the point by creating the next number exclusively (O_CREAT and O_EXCL), which succeeds for one process
only. Files are never removed or renamed, so no lock is needed, and a claim cannot be removed by mistake: where flock is
missing (some network file systems of clusters), two processes still never work on one point.

While the owner works, it touches its file. When it ends, it writes 0001.end.json with the exit code. A claim without
end is lost if its owner is dead. On the machine of the owner this is known from the process, elsewhere from the age of
the file, measured with the clock of the file system. An owner that was suspended for longer finds the next claim, and
ends its run. A claim that cannot be read has an unknown owner, who may be elsewhere. An end that cannot be read is that
of a killed owner.

The lock of a run (`apt_evap.simulation.checkpoint`) protects its file on one machine. It does not replace a claim:
between machines it may be missing, also without an error (if each node has locks of its own); it is taken seconds after
the start of the program; and the try of the loser would count as failed.
"""

import datetime
import json
import os
import re
import secrets
import socket
import time
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from apt_evap._common.files import FileError, flush_folder, read_small_file
from apt_evap._common.processes import birth, machine
from apt_evap._version import __version__
from apt_evap.sweep.files import unlinked, write

HEARTBEAT = 30.0
"""Time between two touches of a claim [s]."""
LOST_AFTER = 600.0
"""Age of a claim after which its owner on another machine counts as dead [s]. NFS shows new times after up to 60 s, and
a file server may be away for minutes."""
_MAX_BYTES = 1 << 20
_FOLDER = "claims"
_NAME = re.compile(r"([0-9]{4,})\.json")
_OWNER: dict[str, tuple[type, ...]] = dict.fromkeys(("host", "machine", "birth", "job", "version", "began"), (str,))
_OWNER |= dict.fromkeys(("pid", "restarts", "ions"), (int,))
_END = {"code": (int,), "ended": (str,), "seconds": (int, float), "ions": (int,), "message": (str,)}
_LARGEST = 1 << 31  # of a number in a claim: process numbers are below it
_KILLED = {"code": -9, "ended": "", "seconds": 0.0, "ions": 0, "message": ""}
_JOB_IDS = ("SLURM_ARRAY_JOB_ID", "SLURM_JOB_ID", "PBS_JOBID", "LSB_JOBID", "JOB_ID")
_TASK_IDS = ("SLURM_ARRAY_TASK_ID", "PBS_ARRAY_INDEX", "LSB_JOBINDEX")


@dataclass(frozen=True)
class Claim:
    """One try of a point: who has claimed it and, if it has ended, how.

    Parameters
    ----------
    number : int
        Number of the try, from 1.
    owner : dict
        host, machine, pid, birth, job, restarts (of this job), version, began (ISO), ions (of the run at the
        beginning).
    end : dict or None
        code (exit code of the run, negative for a signal), ended (ISO), seconds, ions, message.
    """

    number: int
    owner: dict = field(default_factory=dict)
    end: dict | None = None

    @property
    def who(self) -> str:
        """Text on the owner, str."""
        if not self.owner:
            return "an unknown process"
        job = f", job {self.owner['job']}" if self.owner.get("job") else ""
        return f"process {self.owner['pid']} on {self.owner['host']}{job}"


class Claims:
    """The claims of one point.

    Parameters
    ----------
    folder : Path
        Folder of the point.

    Raises
    ------
    FileError
        If the folder of the claims is a link.
    """

    def __init__(self, folder: Path) -> None:
        self.folder = unlinked(folder / _FOLDER)

    def all(self) -> list[Claim]:
        """All claims, in their order, list of Claim."""
        try:
            names = set(os.listdir(self.folder))
        except FileNotFoundError:
            return []
        except OSError as error:
            raise FileError(f"cannot read {str(self.folder)!r}: {error.strerror}") from error
        numbers = {int(match[1]) for name in names if (match := _NAME.fullmatch(name))}
        return [
            Claim(
                number,
                _read(self._path(number), _OWNER) or {},
                (_read(self._end(number), _END) or _KILLED) if self._end(number).name in names else None,
            )
            for number in sorted(numbers)
            if self._path(number).name in names
        ]

    def is_held(self, claim: Claim) -> bool:
        """Whether the owner of a claim without end is alive."""
        owner = claim.owner
        if owner and owner["machine"] == machine():
            return birth(owner["pid"]) == owner["birth"]
        if owner and owner["job"] and owner["job"] == job() and owner["restarts"] < restarts():
            return False  # the batch system has started this job again, because its node failed or was needed
        try:
            return abs(self._now() - self._path(claim.number).lstat().st_mtime) < LOST_AFTER
        except OSError:
            return True  # the file system is away: not known, so the point stays with its owner

    def take(self, previous: int, ions: int) -> Claim | None:
        """Claim the point.

        Parameters
        ----------
        previous : int
            Number of the last claim, which must have ended or be lost; 0 if there is none.
        ions : int
            Number of ions of the run so far.

        Returns
        -------
        Claim or None
            None if another process was faster.
        """
        owner = {
            "host": socket.gethostname(),
            "machine": machine(),
            "pid": os.getpid(),
            "birth": birth(os.getpid()),
            "job": job(),
            "restarts": restarts(),
            "version": __version__,
            "began": now(),
            "ions": ions,
        }
        try:
            self.folder.mkdir(exist_ok=True)
            descriptor = os.open(self._path(previous + 1), os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o666)
        except FileExistsError:
            return None
        except OSError as error:
            raise FileError(f"cannot write {str(self._path(previous + 1))!r}: {error.strerror}") from error
        with open(descriptor, "w") as file:
            json.dump(owner, file)
            file.flush()
            os.fsync(descriptor)
        flush_folder(self.folder)
        return Claim(previous + 1, owner)

    def renew(self, claim: Claim) -> bool:
        """Touch a claim; return whether it is still the valid one."""
        try:
            os.utime(self._path(claim.number))
            return not self._path(claim.number + 1).exists()
        except OSError:
            return True  # the file system is away: tried again with the next heartbeat

    def end(self, claim: Claim, **end: Any) -> Claim:
        """Write the end of a claim; the point is free afterwards."""
        end["ended"] = now()
        write(self._end(claim.number), json.dumps(end, indent=1))
        return Claim(claim.number, claim.owner, end)

    def _path(self, number):
        return self.folder / f"{number:04d}.json"

    def _end(self, number):
        return self.folder / f"{number:04d}.end.json"

    def _now(self):
        """Time of the file system, which may differ from that of this machine."""
        probe = self.folder / f".{os.getpid()}.{secrets.token_hex(8)}"
        try:
            descriptor = os.open(probe, os.O_WRONLY | os.O_CREAT | os.O_EXCL)
        except OSError:
            return time.time()  # read-only for this user
        try:
            return os.fstat(descriptor).st_mtime
        finally:
            os.close(descriptor)
            probe.unlink()


def _read(path, kinds):
    """Content of a file of a claim; None if it has other keys or types, or is not written yet."""
    try:
        content = json.loads(read_small_file(path, _MAX_BYTES, "a claim"))
        values = {name: content[name] for name in kinds}
    except (FileError, ValueError, KeyError, TypeError, RecursionError):
        return None
    for name, value in values.items():
        if type(value) not in kinds[name]:
            return None
        if isinstance(value, str):  # it is printed
            values[name] = "".join(letter if letter.isprintable() else " " for letter in value)
        elif not -_LARGEST < value < _LARGEST:
            return None
    return values


def job() -> str:
    """Job of the batch system in which this process runs, str; "" outside a batch system."""
    parts = [next((os.environ[name] for name in names if os.environ.get(name)), "") for names in (_JOB_IDS, _TASK_IDS)]
    return "_".join(part for part in parts if part)


def restarts() -> int:
    """Number of times that Slurm has started this job again."""
    number = os.environ.get("SLURM_RESTART_COUNT", "0")
    return int(number) if number.isdigit() else 0


def now() -> str:
    """Time of this machine, with its time zone, str."""
    return datetime.datetime.now().astimezone().isoformat(timespec="milliseconds")
