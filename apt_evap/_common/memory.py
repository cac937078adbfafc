"""Memory that a specimen needs."""

# Measured: the peak memory to build and charge a specimen and fly 300 ions agrees within 15 % with the first two
# numbers, for 18 specimens (five lattices, 0.4 to 28 million atoms, complete or a shell). The third number is 150 to
# 215 for 1 to 8 threads.
_BYTES_PER_ATOM = 81
_BYTES_PER_SURFACE_ATOM = 577
_BYTES_PER_COPIED_ATOM = 180


def _available_memory():
    """Free memory [bytes], or None if the system does not report it (other than Linux)."""
    try:
        with open("/proc/meminfo") as lines:
            return next(int(line.split()[1]) * 1024 for line in lines if line.startswith("MemAvailable"))
    except (OSError, StopIteration):
        return None


def needed_memory(atoms: float, surface_atoms: float) -> float:
    """Peak memory [bytes] of a specimen and its charges, from its numbers of atoms and of surface atoms."""
    return _BYTES_PER_ATOM * atoms + _BYTES_PER_SURFACE_ATOM * surface_atoms


def copied_memory(surface_atoms: float, n_threads: int) -> float:
    """Memory [bytes] of the copies of the surface, one per thread."""
    return _BYTES_PER_COPIED_ATOM * surface_atoms * n_threads


def check_memory(atoms: float, surface_atoms: float) -> None:
    """Check that a specimen and its charges fit into the free memory."""
    _check(
        needed_memory(atoms, surface_atoms),
        f"a tip of {atoms:.2g} atoms",
        "give a depth (keeps only the atoms near the surface), a smaller apex_radius or a shorter shank_length",
    )


def check_copies(surface_atoms: float, n_threads: int) -> None:
    """Check that the copies of the surface, one per thread, fit into the free memory (ValueError)."""
    _check(
        copied_memory(surface_atoms, n_threads),
        f"n_threads={n_threads} (--threads), each with a copy of {surface_atoms:.2g} surface atoms,",
        "use fewer threads",
    )


def _check(needed, what, advice):
    free = _available_memory()
    if free is not None and not needed <= free:
        needed, free = (f"{size / 1e9:.2g}" if size < 1e11 else f"{size / 1e9:,.0f}" for size in (needed, free))
        raise ValueError(f"{what} needs about {needed} GB, {free} GB are free; {advice}")
