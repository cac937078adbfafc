"""Reading of a file of any kind: a run, ions or a map."""

from collections.abc import Sequence
from typing import Any

from apt_evap._common.files import FileError, check_path
from apt_evap._common.types import AnyPath
from apt_evap._common.validation import short_text
from apt_evap.io import formats
from apt_evap.simulation.run import load
from apt_evap.simulation.run_hdf5 import is_run


def read(
    path: AnyPath,
    *,
    format: str | None = None,
    columns: Sequence[str] | None = None,
    ranges: AnyPath | formats.Ranges | None = None,
    **options: Any,
) -> Any:
    """Read a file of ions, a run or a map. The format is recognised by the first bytes if possible, or by the suffix.

    Parameters
    ----------
    path : str or path-like
        The file: .pos, .epos, .apt, .raw, .ato, .nxs, .h5 (a run, NXapm or PyCCAPT), .npz, or a result table of TAPSim.
    format : str, optional
        Suffix of the format, such as ".pos", for any name of the file.
    columns : sequence of str, optional
        Names of the columns to read; only these are kept in memory. All by default. Not for a run, an .npz and TAPSim.
    ranges : str, path-like or Ranges, optional
        Ranges of mass of the ions, or a file of these; the result has them as `Hits.ranges`.
    **options
        Options of the reader of the format: ``partial=True`` reads the complete ions of a truncated file (the complete
        sections of an .apt), ``byte_order="little"`` a .pos or .epos in the wrong byte
        order, ``voltage_unit="V"`` an .epos with voltages below 100 V, ``detector_unit="cm"`` an .epos or .raw with
        detector coordinates in cm; for an .npz the options of `read_map`.

    Returns
    -------
    Hits
        The ions; for the .h5 of a simulation a `Run`, with the method `Run.hits`; for an .npz a `DetectorMap`.

    Raises
    ------
    FileError
        If the file is missing, unreadable, empty or of unknown format, or if an option or column does not exist.
    TruncatedFile
        If it ends in the middle of an ion.

    Examples
    --------
    >>> ions = ae.Hits(positions=np.zeros((3, 3)), mass_to_charge=[29.0, 29.0, 58.0])
    >>> ae.write("ni.pos", ions)
    >>> hits = ae.read("ni.pos")
    >>> hits
    <Hits: 3 ions, 3 detected from 'ni.pos'; mass_to_charge, positions>
    >>> hits.mass_to_charge  # Da
    array([29., 29., 58.], dtype=float32)
    """
    if formats.format_of(path, format).suffix != ".h5" or not is_run(path):
        return formats.read(path, format=format, columns=columns, ranges=ranges, **options)
    name = str(check_path(path))
    for option in options:
        raise FileError(f"{name!r}: reading .h5 files takes no options, got {option!r}")
    if ranges is not None:
        raise FileError(f"{name!r}: the ions of a run have elements, so that reading it takes no ranges")
    if columns is not None:
        raise FileError(f"{name!r}: reading a run takes no columns, got {short_text(columns)}")
    return load(path)
