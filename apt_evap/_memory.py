"""Whether a specimen fits into the memory."""

# Peaks of building a specimen, charging it and flying 300 ions, of 18 specimens of five lattices with 1 to 28 million
# atoms, whole or a shell: within 15 % of these two numbers. Building alone takes 52 to 63 per atom.
_BYTES_PER_ATOM = 81
_BYTES_PER_SURFACE_ATOM = 577


def _available_memory():
    """Free memory [bytes], or None where the system does not say (other than Linux)."""
    try:
        with open("/proc/meminfo") as lines:
            return next(int(line.split()[1]) * 1024 for line in lines if line.startswith("MemAvailable"))
    except (OSError, StopIteration):
        return None


def check_memory(atoms, surface_atoms):
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
    needed, free = needed_memory(atoms, surface_atoms), _available_memory()
    if free is not None and not needed <= free:
        raise ValueError(
            f"a tip of {atoms:.2g} atoms, {surface_atoms:.2g} of them on the surface, needs about {needed / 1e9:.2g} GB, "
            f"{free / 1e9:.2g} GB are free; give depth=... to hold only the atoms near the surface, a smaller "
            "apex_radius or a shorter shank_length"
        )


def needed_memory(atoms, surface_atoms):
    """Memory [bytes] that a specimen and its charges take at most; parameters as for `check_memory`."""
    return _BYTES_PER_ATOM * atoms + _BYTES_PER_SURFACE_ATOM * surface_atoms
