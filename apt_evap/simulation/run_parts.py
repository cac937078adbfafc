"""The parts of a run as they come, and a surface brought to where a run that is resumed ended."""

from dataclasses import replace

import numpy as np

from apt_evap._core.evaporation import EXHAUSTED, SWEEP_DUE, TOO_SHALLOW
from apt_evap.evaporation.emitter import Emitter
from apt_evap.simulation.checkpoint import Keeper
from apt_evap.simulation.history import History
from apt_evap.simulation.run import Run

TOGETHER = 64
"""Parts that are joined as they come: small arrays that stay between large ones that go keep the memory of these. Left
one by one, 100,000 ions of R = 20 a took 540 bytes each, of which 144 are results; joined, 155."""


class Parts:
    """The parts of a run in memory, and on the disk where a `Keeper` keeps them.

    Parameters
    ----------
    keeper : Keeper or None
        Where they are kept.
    emitter : Emitter
        The surface, whose state goes with them.
    """

    def __init__(self, keeper: Keeper | None, emitter: Emitter) -> None:
        self.watch = None
        self.done = [keeper.done] if keeper and keeper.done else []
        self._keeper, self._emitter = keeper, emitter
        self._new, self._latest = [], []
        self._first_event = self.done[0].first_event if self.done else emitter.counts["events"]

    def __len__(self) -> int:
        return sum(map(len, (*self.done, *self._new, *self._latest)))

    def append(self, part: Run) -> None:
        """Add the next part."""
        self._latest.append(part)
        if len(self._latest) == TOGETHER:
            self._gather()

    def _gather(self):
        if self._latest:
            self._new.append(Run.join(self._latest))
            self._latest = []

    def _joined(self):
        self._gather()
        # the history goes with the last part, as it is taken but once
        if self._new:
            joined = Run.join(self._new)
            self._new = [replace(joined, history=History.join([joined.history, self.watch.take()]))]
        return self._new

    def keep(self) -> None:
        """Write what is new to the disk."""
        if self._keeper and len(self) > sum(map(len, self.done)):
            if self._keeper.write(self._joined()[0], self._emitter.state(), self._first_event):
                self.done += self._new
                self._new = []

    def run(self, ended: str = "") -> Run:
        """Join all parts into one run."""
        run = Run.join([*self.done, *self._joined()])
        return replace(run, state=self._emitter.state(), first_event=self._first_event, ended=ended)


def catch_up(emitter: Emitter, run: Run, batch_size: int) -> None:
    """Bring a new surface to where a run ends, by its state and the events since.

    Parameters
    ----------
    emitter : Emitter
        Of the settings of the run.
    run : Run
        What has been done; without a state all its events happen again.
    batch_size : int
        Events at a time.

    Raises
    ------
    ValueError
        If atoms have left the emitter, or its events are not those of the run.
    """
    if emitter.counts["events"]:
        raise ValueError(f"a run is resumed by a new Simulation, got one that {emitter.counts['events']:,} atoms left")
    if run.state is not None:
        emitter.restore(run.state)
    ions = emitter.counts["events"] - run.first_event  # ions of the run that have left; those before it count down
    same = ions <= len(run)
    while same and ions < len(run):
        batch = emitter.evaporate(min(batch_size, len(run) - ions))
        known = slice(max(ions, 0), max(ions + len(batch), 0))
        kept = slice(len(batch) - (known.stop - known.start), None)
        same = np.array_equal(batch.site[kept], run.site[known])
        same = same and np.array_equal(batch.charges[kept], run.charges[known])
        ions += len(batch)
        if batch.status == SWEEP_DUE:
            emitter.relax()
        elif batch.status == TOO_SHALLOW:
            emitter.deepen()
        same = same and batch.status != EXHAUSTED
    if not same:
        raise ValueError(
            "the run cannot be resumed: its events do not come out the same again, as with another version of the "
            "program, or a surface that was changed by hand"
        )
