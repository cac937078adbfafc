"""The emitter: the charged surface of a specimen, and the sequence of atoms that leave it."""

import warnings
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from apt_evap._common.describe import describe
from apt_evap._common.threads import thread_count, usable_threads
from apt_evap._common.types import Floats, Integers
from apt_evap._common.validation import check_array, check_count, check_kind, check_number
from apt_evap._common.warnings import ChargesWarning
from apt_evap._core.evaporation import DONE, EXHAUSTED, SWEEP_DUE, TOO_SHALLOW, Evaporation, Start
from apt_evap._core.journal import Journal
from apt_evap._core.neighbourhood import Neighbourhood
from apt_evap._core.octree import Octree
from apt_evap.evaporation import rule as rules
from apt_evap.evaporation.law import Extremal, Law, check_law, kernel_of
from apt_evap.evaporation.settings import ChargeSettings, check_angle
from apt_evap.evaporation.state import EmitterState
from apt_evap.evaporation.voltage import check_voltage
from apt_evap.specimen.ase_atoms import to_atoms
from apt_evap.specimen.tip import Tip
from apt_evap.units import COULOMB

RECORD = 16_384  # events after which a batch comes with a tree in any case, so that nobody has to keep the journals
BATCH = 256  # events at a time; results do not depend on it

__all__ = ["BATCH", "DONE", "EXHAUSTED", "SWEEP_DUE", "TOO_SHALLOW", "Batch", "Emitter"]

_MAX_EVENTS = 10_000_000  # at a time: 720 MB of results


@dataclass(frozen=True, eq=False, repr=False)
class Batch:
    """Atoms that left one after the other.

    Parameters
    ----------
    site : ndarray of int64, shape (n,)
        Index of each atom in the specimen.
    charges : ndarray, shape (n,)
        Charge before it left [e].
    fields : ndarray, shape (n,)
        Field just outside before it left [V/nm].
    normals : ndarray, shape (n, 3)
        Outward unit normal.
    neighbour : ndarray of int64, shape (n,)
        Index of the surface nearest neighbour with the highest charge; -1 if there was none.
    journal : Journal
        What each event changed in the tree.
    tree : Octree or None
        Copy of the tree before the first event, if it was built anew since the batch before, or that was long ago.
    status : int
        DONE, SWEEP_DUE, EXHAUSTED or TOO_SHALLOW.
    """

    site: np.ndarray
    charges: np.ndarray
    fields: np.ndarray
    normals: np.ndarray
    neighbour: np.ndarray
    journal: Journal
    tree: Octree | None
    status: int

    def __len__(self) -> int:
        return len(self.site)

    def __repr__(self) -> str:
        status = {DONE: "done", SWEEP_DUE: "sweep due", EXHAUSTED: "exhausted", TOO_SHALLOW: "too shallow"}[self.status]
        return f"<Batch: {len(self):,} atoms left one after the other; {status}>"


class Emitter:
    """The charged surface of a specimen.

    Parameters
    ----------
    tip : Tip
        The specimen.
    voltage : float
        Applied voltage [V].
    law : law, optional
        Which atom leaves next; by default `Extremal`. One of your own: see `apt_evap.evaporation.law.Law`.
    settings : ChargeSettings
        How finely the charges are solved.
    n_threads : int, optional
        Threads; by default the processors this process may use.
    rule : charging rule, optional
        How charge distributes over the surface; by default `Robin`. One of your own: see
        `apt_evap.evaporation.rule.Rule`.

    Raises
    ------
    ValueError
        If the voltage is not above 0, or the specimen has no surface atom that may leave.
    """

    def __init__(
        self,
        tip: Tip,
        voltage: float = 1000.0,
        law: Law | None = None,
        settings: ChargeSettings | None = None,
        n_threads: int | None = None,
        rule: rules.Rule | rules.CompiledRule | None = None,
    ) -> None:
        self.tip = check_kind(tip, "tip", Tip, "a Tip")
        self.voltage = check_voltage(voltage)
        self.law = Extremal() if law is None else law
        check_law(self.law)
        self.settings = ChargeSettings() if settings is None else settings
        check_kind(self.settings, "settings", ChargeSettings, "ChargeSettings")
        self.rule = rules.Robin() if rule is None else rule
        rules.check_rule(self.rule)
        self.n_threads = thread_count(n_threads)
        distance = tip.nearest_neighbour_distance
        self._core = Evaporation(
            self._neighbourhood_of(tip),
            rules.kernel_of(self.rule, tip),
            kernel_of(self.law, tip),
            self.voltage / COULOMB,
            COULOMB,
            self.settings.patch_radius * distance,
            self.settings.update_radius * distance,
            self.settings.opening_angle,
        )
        self._left, self._deepened = [], []  # sites batch by batch; events at which more of the specimen was held
        if not tip.evaporable[self._core.atoms.surface].any():
            raise ValueError(f"{tip!r} has no evaporable surface atom")
        self.relax(tolerance=self.settings.start_tolerance)
        if self._core.next_slot < 0:
            raise ValueError(
                f"law {describe(self.law)['name']} gives no surface atom of {tip!r} a key above 0: no atom may leave"
            )
        self.sweep_interval = self.settings.sweep_interval or max(100, len(self) // 300)

    def _neighbourhood_of(self, tip, before=None):
        return Neighbourhood(
            tip.positions,
            tip.neighbour_radius,
            tip.surface_threshold,
            tip.support.view(np.int8),
            tip.bond_length,
            usable_threads(self.n_threads),
            before,
        )

    def __len__(self) -> int:
        return len(self._core.slots)

    def __reduce__(self):
        raise TypeError("an Emitter cannot be pickled or copied: make one of the same tip and restore its `state()`")

    def __repr__(self) -> str:
        return f"<Emitter: {len(self):,} surface atoms of {len(self.tip.positions):,} at {self.voltage:g} V>"

    @property
    def atoms(self) -> Integers:
        """Index of each surface atom in the specimen, shape (n,)."""
        return self._core.tree.atoms[self._core.slots]

    @property
    def positions(self) -> Floats:
        """Positions of the surface atoms [nm], shape (n, 3)."""
        return self._core.tree.positions[self._core.slots]

    @property
    def normals(self) -> Floats:
        """Outward unit normals of the surface atoms, shape (n, 3)."""
        return self._core.slot_normals[self._core.slots]

    @property
    def charges(self) -> Floats:
        """Charges of the surface atoms [e], shape (n,)."""
        return self._core.tree.charges[self._core.slots]

    def charge_residuals(self, chosen: Integers) -> Floats:
        """How far charges are from the equation of the charging rule, by direct sums over all others.

        Parameters
        ----------
        chosen : ndarray of int, shape (m,)
            Which of the surface atoms.

        Returns
        -------
        ndarray, shape (m,)
            Residuals over the mean charge; NaN for a rule that cannot say.
        """
        return self._core.rule.residuals(self.positions, self.normals, self.charges, chosen)

    @property
    def fields(self) -> Floats:
        """Fields just outside the surface atoms [V/nm], shape (n,).

        What the law sees. By Robin's rule F_i = 4 pi k_e q_i / s, with s the area per surface atom: the field at the
        outer face of a charged surface.
        """
        return self._core.slot_fields[self._core.slots]

    @property
    def bonds(self) -> Integers:
        """Nearest neighbours of the surface atoms that are still there, shape (n,)."""
        return self._core.atoms.bond_counts[self.atoms].astype(np.int64)

    def to_atoms(self) -> Any:
        """Return the surface as ase.Atoms [Angstrom]; needs ASE.

        Returns
        -------
        ase.Atoms
            With arrays "charge" [e], "field" [V/nm], "normal" and "atom", the index in the specimen.
        """
        arrays = {"charge": self.charges, "field": self.fields, "normal": self.normals, "atom": self.atoms}
        return to_atoms(self.positions, self.tip.elements, self.tip.species[self.atoms], **arrays)

    @property
    def area_per_atom(self) -> float:
        """Area s of the surface per atom, as of the last relaxation [nm^2]."""
        return self._core.rule.area

    @property
    def counts(self) -> dict[str, int]:
        """Events so far, charges that came out negative and were set to 0, patches that did not settle; dict of int."""
        core = self._core
        return {"events": core.n_removed, "clipped": core.n_clipped, "unsettled": core.n_unsettled}

    def field_at(self, points: ArrayLike, opening_angle: float = 0.3) -> Floats:
        """Electric field of the surface charges.

        Parameters
        ----------
        points : array_like, shape (m, 3)
            Where [nm].
        opening_angle : float
            See `ChargeSettings`; 0 sums over all atoms.

        Returns
        -------
        ndarray, shape (m, 3)
            Field [V/nm].
        """
        points, opening_angle = check_array(points, "points", ("m", 3)), check_angle(opening_angle)
        return COULOMB * self._core.tree.fields(points, opening_angle, usable_threads(self.n_threads))

    def potential_at(self, points: ArrayLike, opening_angle: float = 0.3) -> Floats:
        """Electric potential of the surface charges [V], shape (m,); parameters as in `field_at`."""
        points, opening_angle = check_array(points, "points", ("m", 3)), check_angle(opening_angle)
        return COULOMB * self._core.tree.potentials(points, opening_angle, usable_threads(self.n_threads))

    def relax(self, tolerance: float | None = None) -> tuple[int, float]:
        """Bring the whole surface to equilibrium at the applied voltage.

        Parameters
        ----------
        tolerance : float, optional
            Change of a charge in the last sweep, relative to the mean charge. By default the one of the settings, and
            with their `relaxation_angle`; one given here is reached with the finer `opening_angle`.

        Returns
        -------
        sweeps : int
            Sweeps done.
        residual : float
            The change in the last one.
        """
        angle = self.settings.relaxation_angle if tolerance is None else self.settings.opening_angle
        tolerance = self.settings.tolerance if tolerance is None else tolerance
        tolerance = check_number(tolerance, "tolerance", above=0, at_most=1)
        return self._relax(tolerance, angle)

    def _relax(self, tolerance, angle, start=None):
        counts = self.counts
        self._relaxed = (tolerance, angle, counts["clipped"], counts["unsettled"])
        outcome = self._core.relax(
            tolerance=tolerance,
            opening_angle=angle,
            double_precision=tolerance < 1e-6,  # below it the rounding of float32 keeps charges moving
            n_threads=usable_threads(self.n_threads),
            start=start,
        )
        self._recorded = RECORD
        if not outcome[1] < tolerance:
            warnings.warn(
                f"charges did not converge in {outcome[0]} sweeps: largest relative change {outcome[1]:.1g} "
                f"(tolerance {tolerance:.1g})",
                ChargesWarning,
                stacklevel=3,
            )
        return outcome

    def state(self) -> EmitterState:
        """What rebuilds the surface as its last relaxation left it.

        Returns
        -------
        EmitterState
        """
        start = self._core.start
        sites = np.concatenate([np.empty(0, np.int64), *self._left])
        self._left = [sites]
        tolerance, angle, clipped, unsettled = self._relaxed
        return EmitterState(
            sites=sites[: start.n_removed],
            charges=start.charges,
            lonely=start.lonely,
            lonely_normals=start.lonely_normals,
            deepened=tuple(self._deepened),
            tolerance=tolerance,
            opening_angle=angle,
            clipped=clipped,
            unsettled=unsettled,
            rule_state=start.rule_state,
        )

    def restore(self, state: EmitterState) -> None:
        """Rebuild the surface that another emitter of the same settings had.

        Parameters
        ----------
        state : EmitterState
            Of the other; the surface becomes what its last relaxation left, and events go on from there.

        Raises
        ------
        ValueError
            If atoms have left already, or the state is of another specimen.
        """
        if self.counts["events"]:
            raise ValueError(f"restore needs a new emitter, got one that {self.counts['events']:,} atoms have left")
        done = 0
        for event in state.deepened:
            self._core.atoms.remove_atoms(state.sites[done:event])
            self._hold_more()
            done = event
        self._core.atoms.remove_atoms(state.sites[done:])
        if not np.isin(state.lonely, self._core.atoms.surface).all() or len(state.lonely) != len(state.lonely_normals):
            raise ValueError("lonely must be surface atoms, each with a normal: the state is of another specimen")
        self._left, self._deepened = [state.sites], list(state.deepened)
        self._core.n_clipped, self._core.n_unsettled = state.clipped, state.unsettled
        start = Start(len(state.sites), state.charges, state.lonely, state.lonely_normals, state.rule_state)
        self._relax(state.tolerance, state.opening_angle, start)

    def hand_out_tree(self) -> None:
        """Let the next batch come with a copy of the tree, for flights that have not followed the events so far."""
        self._recorded = RECORD

    def deepen(self) -> None:
        """Hold more of the specimen, after `evaporate` came upon atoms that are only held as support.

        The atoms held so far keep their numbers.

        Raises
        ------
        ValueError
            If the specimen has nothing below: one made from positions.
        """
        self._hold_more()
        self._deepened.append(self._core.n_removed)
        self.relax()

    def _hold_more(self):
        tip = self.tip.deepened()
        neighbourhood = self._neighbourhood_of(tip, self._core.atoms)
        self._core.take_over(neighbourhood, kernel_of(self.law, tip))
        self.tip = tip

    def evaporate(self, max_events: int) -> Batch:
        """Evaporate up to `max_events` atoms.

        Stops early if the surface must be relaxed, the shell deepened, or no atom is left; `advance` does that by
        itself.

        Parameters
        ----------
        max_events : int
            Events at most.

        Returns
        -------
        Batch
            Its status says why it ended: DONE, SWEEP_DUE (call `relax` and continue), EXHAUSTED, TOO_SHALLOW (call
            `deepen` and continue).
        """
        n = check_count(max_events, "max_events", at_least=1, at_most=_MAX_EVENTS)
        journal = Journal(self.tip.positions, n)
        site, neighbour = np.empty(n, np.int64), np.empty(n, np.int64)
        charges, fields, normals = np.empty(n), np.empty(n), np.empty((n, 3))
        tree = self._core.tree.copy() if self._recorded >= RECORD else None
        status = self._core.evaporate(journal, n, self.sweep_interval, site, charges, fields, normals, neighbour)
        n = journal.n_events
        self._recorded = n if tree is not None else self._recorded + n
        self._left.append(site[:n].copy())
        return Batch(
            site=site[:n],
            charges=charges[:n],
            fields=fields[:n],
            normals=normals[:n],
            neighbour=neighbour[:n],
            journal=journal,
            tree=tree,
            status=status,
        )

    def advance(
        self,
        n_events: int,
        batch_size: int = BATCH,
        pause: Callable[[], AbstractContextManager[Any]] = nullcontext,
    ) -> Iterator[Batch]:
        """Evaporate atoms batch by batch; relaxes the surface and deepens the shell between them.

        Parameters
        ----------
        n_events : int
            Atoms to evaporate.
        batch_size : int
            Events at a time; the sequence does not depend on it.
        pause : callable, optional
            Gives a context in which the surface is relaxed or the shell deepened: what needs the processors, or the
            specimen as it was, stands still in it.

        Yields
        ------
        Batch
            May be empty. What its status asks for is done once the next batch is asked for, so that the surface can be
            looked at before. The last one is EXHAUSTED if no atom is left.
        """
        n_events = check_count(n_events, "n_events", at_least=0)
        batch_size = check_count(batch_size, "batch_size", at_least=1, at_most=_MAX_EVENTS)
        while n_events > 0:
            batch = self.evaporate(min(batch_size, n_events))
            n_events -= len(batch)
            yield batch
            if batch.status == EXHAUSTED:
                return
            if batch.status in (SWEEP_DUE, TOO_SHALLOW):
                with pause():
                    self.relax() if batch.status == SWEEP_DUE else self.deepen()
