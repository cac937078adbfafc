"""The .epos format: a .pos with time of flight, voltages, detector and pulses, 44 bytes per ion, big-endian.

Larson et al., Local Electrode Atom Probe Tomography (Springer, 2013), appendix A; voltages are in V and
detector coordinates in mm in real files, against the units printed there.
"""

import warnings

import numpy as np

from apt_evap.hits import Hits
from apt_evap.io._records import choose, read_words, write_words

_ROW = 44
_GROUPS = [(0, 3, "f4"), *((word, 1, "f4") for word in range(3, 9)), (9, 1, "u4"), (10, 1, "u4")]


def read_epos(path, *, partial=False, byte_order=None):
    """Read an .epos file.

    A column of zeros counts as absent (None): positions, mass, time of flight, standing voltage, and detector
    coordinates where both are zero. A pulse voltage of zero is kept where there is a standing voltage (laser
    pulsing). Pulses since the last event are kept even if zero, and never used to group ions.

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
        pulse_id and multiplicity come from the last column alone; they are None, with a warning, if it
        contradicts itself. Voltages below 100 throughout are taken for kV and turned into V.

    Raises
    ------
    FileError
        If the file is missing, unreadable, empty or in the wrong byte order.
    TruncatedFile
        If the size is no multiple of 44 bytes and `partial` is False.
    """
    columns, cut = read_words(
        path, _GROUPS, _ROW, "an .epos", partial=partial, byte_order=byte_order, rival=("a .pos", 16)
    )
    positions, mass, time, voltage, pulse_voltage, x, y, pulses, ions = columns
    pulse_id, multiplicity = _group(ions, cut, path)
    voltage, pulse_voltage = _volts(voltage, pulse_voltage)
    detector = x.any() or y.any()
    return Hits(
        positions=positions if positions.any() else None,
        mass_to_charge=mass if mass.any() else None,
        time_of_flight=time if time.any() else None,
        voltage=voltage,
        pulse_voltage=pulse_voltage,
        x=x if detector else None,
        y=y if detector else None,
        pulses=pulses,
        pulse_id=pulse_id,
        multiplicity=multiplicity,
        source=str(path),
    )


def write_epos(path, hits):
    """Write an .epos file; a warning counts the ions left out.

    Left out are ions that did not hit the detector and ions with a value that is not finite. Missing columns
    are written as zeros. The number of ions per pulse is counted anew from pulse_id over the ions written, in
    runs of equal pulse_id; simulated ions without pulse_id are one to a pulse.

    Parameters
    ----------
    path : str or path-like
        The file; an existing one is replaced once the new one is complete.
    hits : Hits
        The ions.

    Raises
    ------
    ValueError
        If no ion is left to write.
    FileError
        If the file cannot be written.
    """
    columns = [
        (0, hits.positions, "f4"),
        (3, hits.mass_to_charge, "f4"),
        (4, hits.time_of_flight, "f4"),
        (5, hits.voltage, "f4"),
        (6, hits.pulse_voltage, "f4"),
        (7, hits.x, "f4"),
        (8, hits.y, "f4"),
        (9, hits.pulses, "u4"),
    ]
    chosen = choose(path, hits, columns)
    ions = np.zeros(len(hits), np.uint32)
    if hits.pulse_id is not None:
        ions[chosen] = _ions_per_pulse(hits.pulse_id[chosen])
    elif hits.outcome is not None or hits.ion is not None:
        ions[:] = 1
    write_words(path, [*columns, (10, ions, "u4")], _ROW, chosen)


def _group(ions, cut, path):
    """Pulse and multiplicity of every ion from the last column: n on the first ion, 0 on the other n - 1."""
    first = np.flatnonzero(ions)
    sizes = np.diff(first, append=len(ions))
    wrong = np.flatnonzero(sizes != ions[first])
    if cut and len(wrong) == 1 and wrong[0] == len(first) - 1 and ions[first[-1]] > sizes[-1]:
        # the file was cut inside its last pulse, whose size is still known
        wrong = wrong[:0]
    if len(first) == 0:
        problem = "it is zero throughout"
    elif first[0] > 0:
        problem = f"its first {first[0]} rows belong to a pulse whose first ion is missing"
    elif len(wrong):
        row, size = first[wrong[0]], sizes[wrong[0]]
        problem = f"row {row} announces {ions[row]} ions in its pulse but the next pulse begins {size} rows later"
        if len(wrong) > 1:
            problem += f" ({len(wrong)} such pulses)"
    else:
        pulse_id = np.cumsum(ions != 0, dtype=np.int64)
        pulse_id -= 1
        multiplicity = ions.copy()
        followers = np.flatnonzero(ions == 0)
        multiplicity[followers] = ions[first[pulse_id[followers]]]
        return pulse_id, multiplicity
    warnings.warn(
        f"{str(path)!r} does not tell which ions share a pulse, so pulse_id and multiplicity are None: the "
        f"ions-per-pulse column is not consistent, {problem}",
        stacklevel=4,
    )
    return None, None


def _ions_per_pulse(pulse_id):
    """Write n on the first ion of each run of equal pulse_id and 0 on the others."""
    first = np.flatnonzero(np.diff(pulse_id, prepend=pulse_id[0] - 1))
    ions = np.zeros(len(pulse_id), np.uint32)
    ions[first] = np.diff(first, append=len(pulse_id))
    return ions


def _volts(voltage, pulse_voltage):
    """Return both voltages in V; None for what is zero throughout and not a laser's missing pulse."""
    present = [column.any() for column in (voltage, pulse_voltage)]
    if not any(present):
        return None, None
    # fmax passes over NaN
    if np.fmax.reduce(voltage if present[0] else pulse_voltage) < 100:
        voltage, pulse_voltage = voltage * np.float32(1000), pulse_voltage * np.float32(1000)
    return (voltage if present[0] else None), pulse_voltage
