"""Journal of events: the changes of the tree by each event, to replay them on a copy.

Flights follow the events on copies of the tree. A replay makes the same calls in the same order, and moments are always
recomputed from charges, so a copy has the same bits as the original tree.
"""

import numpy as np

from apt_evap._core.index cimport Index
from apt_evap._core.octree cimport Octree


cdef class Journal:
    """Changes of the tree by each event of a batch, to be replayed on a copy bit by bit."""

    def __init__(self, const double[:, ::1] positions, Index max_events):
        self.n_events = 0
        self.positions = positions
        self.start = np.zeros(max_events + 1, np.int64)
        self.fresh_start = np.zeros(max_events + 1, np.int64)
        self.slot = np.empty(max_events * 256, np.int32)
        self.charge = np.empty(max_events * 256)
        self.fresh_atom = np.empty(max_events * 8, np.int32)
        self.fresh_leaf = np.empty(max_events * 8, np.int32)

    cdef int reserve(self, Index changes, Index fresh) except -1 nogil:
        # Make space for one more event.
        if self.start[self.n_events] + changes > self.slot.shape[0]:
            with gil:
                self.slot = np.resize(np.asarray(self.slot), 2 * self.slot.shape[0] + changes)
                self.charge = np.resize(np.asarray(self.charge), 2 * self.charge.shape[0] + changes)
        if self.fresh_start[self.n_events] + fresh > self.fresh_atom.shape[0]:
            with gil:
                self.fresh_atom = np.resize(np.asarray(self.fresh_atom), 2 * self.fresh_atom.shape[0] + fresh)
                self.fresh_leaf = np.resize(np.asarray(self.fresh_leaf), 2 * self.fresh_leaf.shape[0] + fresh)
        return 0

    cdef void replay(self, Index event, Octree tree) noexcept nogil:
        # The same calls in the same order as in the event.
        cdef Index k
        cdef int atom
        tree.remove_atom(self.slot[self.start[event]])
        for k in range(self.fresh_start[event], self.fresh_start[event + 1]):
            atom = self.fresh_atom[k]
            tree.insert_atom(atom, self.positions[atom, 0], self.positions[atom, 1], self.positions[atom, 2],
                             self.fresh_leaf[k])
        for k in range(self.start[event] + 1, self.start[event + 1]):
            tree.set_charge(self.slot[k], self.charge[k])
        tree.refresh()

    def replay_on(self, Octree tree, Index event):
        """Replay event number `event` of this journal on a copy of the tree."""
        if not 0 <= event < self.n_events:
            raise IndexError(f"event must be from 0 to {self.n_events - 1}, got {event}")
        self.replay(event, tree)
