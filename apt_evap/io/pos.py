"""The .pos format: position and mass-to-charge ratio of every ion, 16 bytes each, big-endian, no header.

Larson et al., Local Electrode Atom Probe Tomography (Springer, 2013), appendix A.
"""

from apt_evap.hits import Hits
from apt_evap.io._records import choose, read_words, write_words

_ROW = 16


def read_pos(path, *, partial=False, byte_order=None):
    """Read a .pos file.

    Parameters
    ----------
    path : str or path-like
        The file.
    partial : bool
        Read the whole ions of a file that ends in the middle of one.
    byte_order : {None, "big", "little"}
        None reads big-endian after a check that the file is.

    Returns
    -------
    Hits
        With positions [nm] and mass_to_charge [Da].

    Raises
    ------
    FileError
        If the file is missing, unreadable, empty or in the wrong byte order.
    TruncatedFile
        If the size is no multiple of 16 bytes and `partial` is False.
    """
    (positions, mass), _ = read_words(
        path,
        [(0, 3, "f4"), (3, 1, "f4")],
        _ROW,
        "a .pos",
        partial=partial,
        byte_order=byte_order,
        rival=("an .epos", 44),
    )
    return Hits(positions=positions, mass_to_charge=mass, source=str(path))


def write_pos(path, hits):
    """Write a .pos file; a warning counts the ions left out.

    Left out are ions that did not hit the detector and ions whose position or mass is not finite.

    Parameters
    ----------
    path : str or path-like
        The file; an existing one is replaced once the new one is complete.
    hits : Hits
        Ions with positions; without mass_to_charge zeros are written.

    Raises
    ------
    ValueError
        If there are no positions, or no ion is left to write.
    FileError
        If the file cannot be written.
    """
    (positions,) = hits.require("positions")
    columns = [(0, positions, "f4"), (3, hits.mass_to_charge, "f4")]
    write_words(path, columns, _ROW, choose(path, hits, columns))
