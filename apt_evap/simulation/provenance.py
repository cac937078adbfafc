"""Provenance of a run: version, time, libraries and type of processor.

These are not settings: a run may be resumed on another machine, with the same bits. If the bits ever differ, this
record helps to find the reason.
"""

import datetime
import functools
import platform
from collections.abc import Iterable, Mapping
from typing import Any

import h5py
import numpy as np
import scipy

from apt_evap._common.version import __version__


def provenance_now() -> dict[str, Any]:
    """Provenance of a run of this process at this time, in the plain types of JSON."""
    created = datetime.datetime.now(datetime.UTC).isoformat(timespec="seconds")
    return {"version": __version__, "created": created, "systems": [dict(system())]}


@functools.cache
def system() -> Mapping[str, str]:
    """Processor and libraries of this process."""
    return {
        "processor": _processor(),
        "machine": platform.machine(),
        "libc": " ".join(platform.libc_ver()),
        "python": platform.python_version(),
        "numpy": np.__version__,
        "scipy": scipy.__version__,
        "h5py": h5py.version.version,
        "hdf5": h5py.version.hdf5_version,
    }


def joined(parts: Iterable[Mapping[str, Any]]) -> dict[str, Any]:
    """Join the provenances of the parts of a run: that of the first part, with the systems of all parts."""
    first, *others = parts
    systems = list(first.get("systems", ()))
    for part in others:
        systems += [system for system in part.get("systems", ()) if system not in systems]
    return {**first, "systems": systems} if systems else dict(first)


def _processor():
    """Name of the processor."""
    try:
        with open("/proc/cpuinfo", encoding="utf-8", errors="replace") as file:
            for line in file:
                if line.startswith("model name"):
                    return line.partition(":")[2].strip()
    except OSError:
        pass  # not a Linux system
    return platform.processor()
