"""Whether a specimen fits into the memory."""

# R = 100 nm, 46 million atoms: 60 at the peak of building the tip, 140 with the surface and its solver
_BYTES_PER_ATOM = 140


def _available_memory():
    """Free memory [bytes], or None where the system does not say (other than Linux)."""
    try:
        with open("/proc/meminfo") as lines:
            return next(int(line.split()[1]) * 1024 for line in lines if line.startswith("MemAvailable"))
    except (OSError, StopIteration):
        return None


def check_memory(atoms):
    """Refuse a specimen that does not fit into the memory that is free.

    Parameters
    ----------
    atoms : float
        Atoms to hold, approximately.

    Raises
    ------
    ValueError
        Naming what is needed and what is free.
    """
    needed, free = atoms * _BYTES_PER_ATOM, _available_memory()
    if free is not None and needed > free:
        raise ValueError(
            f"a tip of {atoms:.2g} atoms needs about {needed / 1e9:.2g} GB, {free / 1e9:.2g} GB are free; "
            "give depth=... to hold only the atoms near the surface, or a smaller apex_radius"
        )
