"""Whether a specimen fits into the memory."""

from apt_evap._common.wording import argument

# Peaks of building a specimen, charging it and flying 300 ions, of 18 specimens of five lattices with 0.4 to 28 million
# atoms, whole or a shell: within 15 % of what the first two say. The third is 150 to 215, by 1 to 8 threads.
_BYTES_PER_ATOM = 81
_BYTES_PER_SURFACE_ATOM = 577
_BYTES_PER_COPIED_ATOM = 180


def _available_memory():
    """Free memory [bytes], or None where the system does not say (other than Linux)."""
    try:
        with open("/proc/meminfo") as lines:
            return next(int(line.split()[1]) * 1024 for line in lines if line.startswith("MemAvailable"))
    except (OSError, StopIteration):
        return None


def needed_memory(atoms: float, surface_atoms: float) -> float:
    """Most memory [bytes] that a specimen and its charges take, from how many atoms it has and has on the surface."""
    return _BYTES_PER_ATOM * atoms + _BYTES_PER_SURFACE_ATOM * surface_atoms


def check_memory(atoms: float, surface_atoms: float) -> None:
    """Refuse a specimen that, with its charges, does not fit into the memory that is free.

    Parameters
    ----------
    atoms, surface_atoms : float
        Atoms to hold, and how many of them are on the surface, approximately.

    Raises
    ------
    ValueError
        Naming what is needed and what is free.
    """
    _check(
        needed_memory(atoms, surface_atoms),
        f"a tip of {atoms:.2g} atoms",
        "give a depth, to hold only the atoms near the surface, a smaller apex_radius or a shorter shank_length",
    )


def check_copies(surface_atoms: float, n_threads: int) -> None:
    """Refuse more threads than there is memory for, each with a copy of the surface (ValueError)."""
    _check(
        _BYTES_PER_COPIED_ATOM * surface_atoms * n_threads,
        f"{argument('n_threads', n_threads)}, each with a copy of {surface_atoms:.2g} surface atoms,",
        "give fewer",
    )


def _check(needed, what, advice):
    free = _available_memory()
    if free is not None and not needed <= free:
        needed, free = (f"{size / 1e9:.2g}" if size < 1e11 else f"{size / 1e9:,.0f}" for size in (needed, free))
        raise ValueError(f"{what} needs about {needed} GB, {free} GB are free; {advice}")
