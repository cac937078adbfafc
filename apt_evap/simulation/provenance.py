"""Where a run was computed: version, time, libraries and the kind of processor.

None of it is a setting: a run may be resumed elsewhere. But compilers, libraries and processors round differently, so
two runs of the same settings have the same bits only where these are of one kind.
"""

import datetime
import functools
import os
import platform
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import h5py
import numpy as np
import scipy

from apt_evap._version import __version__

_DECISIVE = ("machine", "simd", "numpy", "scipy", "libc", "openblas_coretype")  # what the bits of a run depend on


def provenance_now() -> dict[str, Any]:
    """Provenance of a run that is computed here and now, in the plain types of JSON."""
    created = datetime.datetime.now(datetime.UTC).isoformat(timespec="seconds")
    return {"version": __version__, "created": created, "systems": [dict(system())]}


@functools.cache
def system() -> Mapping[str, str]:
    """Processor and libraries of this process."""
    return {
        "processor": _processor(),
        "machine": platform.machine(),
        "simd": _simd(),
        "libc": " ".join(platform.libc_ver()),
        "python": platform.python_version(),
        "numpy": np.__version__,
        "scipy": scipy.__version__,
        "h5py": h5py.version.version,
        "hdf5": h5py.version.hdf5_version,
        "openblas_coretype": os.environ.get("OPENBLAS_CORETYPE", ""),
    }


def joined(parts: Iterable[Mapping[str, Any]]) -> dict[str, Any]:
    """Provenance of a run whose parts have these: that of the first, with the systems of all."""
    first, *others = parts
    systems = list(first.get("systems", ()))
    for part in others:
        systems += [each for each in part.get("systems", ()) if each not in systems]
    return {**first, "systems": systems} if systems else dict(first)


def other_system(systems: Sequence[Mapping[str, Any]]) -> str:
    """Say in what this system differs from the last of those that a run was computed on; "" if in nothing that counts.

    Parameters
    ----------
    systems : sequence of dict
        Of the run, in their order; none for one of an earlier version.

    Returns
    -------
    str
    """
    if not systems:
        return ""
    here, there = system(), systems[-1]
    differing = [name for name in _DECISIVE if str(there.get(name)) != here[name]]
    return "; ".join(f"{name} was {there.get(name)}, is {here[name]}" for name in differing)


def _processor():
    """Name of the processor, as the system tells it."""
    try:
        with open("/proc/cpuinfo", encoding="utf-8", errors="replace") as file:
            for line in file:
                if line.startswith("model name"):
                    return line.partition(":")[2].strip()
    except OSError:
        pass  # not on this system
    return platform.processor()


def _simd():
    """Instructions that NumPy has chosen its functions by, those of its build included."""
    try:
        from numpy._core._multiarray_umath import __cpu_baseline__, __cpu_dispatch__, __cpu_features__
    except ImportError:  # not in this version of NumPy
        return ""
    chosen = [name for name in __cpu_dispatch__ if __cpu_features__.get(name)]
    return " ".join([*__cpu_baseline__, *chosen])
