"""The table of events: one row per event, whose columns are declared once, in `COLUMNS`."""

import typing

import numpy as np

from apt_evap._core.index cimport Index


class Column(typing.NamedTuple):
    """A number, or a few numbers, of every event."""

    name: str
    dtype: type
    row: tuple
    unit: str | None
    meaning: str


COLUMNS = (
    Column("site", np.int64, (), None, "Index of the atom in the specimen."),
    Column("charges", np.float64, (), "e", "Charge before evaporation."),
    Column("fields", np.float64, (), "V/nm", "Field just outside the surface before evaporation."),
    Column("normals", np.float64, (3,), None, "Outward unit normal."),
    Column(
        "targets", np.int64, (TARGETS,), None,
        "Indices of the atoms onto which an atom may roll: its surface nearest neighbours with the highest charges, "
        "in descending order; -1 if there are fewer.",
    ),
    Column("target_charges", np.float64, (TARGETS,), "e", "Their charges; 0 if there are fewer."),
    Column(
        "waits", np.float64, (), "s",
        "Time before the event; with pulses, time at the top of pulses. 0 for a detached atom.",
    ),
    Column(
        "rises", np.float64, (), None,
        "Natural logarithm of the factor of all rates by the control of the voltage since the last relaxation.",
    ),
    Column(
        "detached", np.bool_, (), None,
        "Whether the atom left because it had lost all chains of bonds to the body.",
    ),
)
ROW = np.dtype([(column.name, column.dtype, column.row) for column in COLUMNS], align=True)

cdef Event blank
blank.site = 0
if tuple(blank) != ROW.names or sizeof(Event) != ROW.itemsize:   # `Events` checks the types, but not the names
    raise ImportError(f"Event of events.pxd has the fields {tuple(blank)}, COLUMNS of events.pyx {ROW.names}")


cdef class Events:
    """Table of events, with their journal; `Evaporation.evaporate` fills both.

    Parameters
    ----------
    positions : ndarray, shape (n_atoms, 3)
        Positions of all atoms of the specimen [nm], for the journal.
    max_events : int
        Number of rows.
    """

    def __init__(self, positions, Index max_events):
        self.journal = Journal(positions, max_events)
        self.table = np.empty(max_events, ROW)
        self.rows = self.table

    def columns(self):
        """Columns of the events so far by name, each of the dtype and shape (n, ...) of `COLUMNS`."""
        return {name: np.ascontiguousarray(self.table[name][:self.journal.n_events]) for name in ROW.names}
