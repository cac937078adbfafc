"""The emitter: the charged surface of a specimen, and the sequence of its evaporating atoms."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass, field, replace
from inspect import cleandoc
from textwrap import fill, indent
from typing import Any, TypeVar

import numpy as np
from numpy.typing import ArrayLike

from apt_evap._common.threads import thread_count, usable_threads
from apt_evap._common.types import Floats, Integers
from apt_evap._common.validation import check_array, check_count, check_kind, check_number, check_seed
from apt_evap._core.evaporation import DONE, EXHAUSTED, SWEEP_DUE, TOO_SHALLOW, Evaporation, RelaxationStart
from apt_evap._core.events import COLUMNS, Events
from apt_evap._core.journal import Journal
from apt_evap._core.neighbourhood import Neighbourhood
from apt_evap._core.octree import Octree
from apt_evap.emission.perturbations import warn_if_not_for
from apt_evap.evaporation import rule as rules
from apt_evap.evaporation.cap import Cap, measure_cap
from apt_evap.evaporation.charge_settings import ChargeSettings, check_angle
from apt_evap.evaporation.law import Extremal, Law, check_law, has_temperature, kernel_of
from apt_evap.evaporation.state import EmitterState
from apt_evap.evaporation.voltage import RateControl, VoltageControl, check_voltage
from apt_evap.specimen.ase_atoms import to_atoms
from apt_evap.specimen.lattice import BOND_FACTORS, SECOND_SHELL_FACTORS
from apt_evap.specimen.tip import Tip
from apt_evap.units import COULOMB
from apt_evap.warnings import ChargesWarning, warn

RECORD = 16_384  # events after which a batch contains a tree in any case, so that journals need not be kept
BATCH = 256  # events per batch; results do not depend on it

__all__ = ["BATCH", "DONE", "EXHAUSTED", "SWEEP_DUE", "TOO_SHALLOW", "Batch", "Emitter"]

T = TypeVar("T")

_SINGLE = 1e-6  # tolerance below which the rounding of float32 prevents convergence
_SEED_STEP = 0x9FB21C651E98DF25  # events have other random numbers than the ions of the same seed

_MAX_EVENTS = 10_000_000  # per call: 1.7 GB of results


def _with_columns(cls: type[T]) -> type[T]:
    """Add the columns of the events to the section Parameters of a docstring, before the journal."""
    entries = ""
    for column in COLUMNS:
        if column.name in cls.__annotations__:
            kind = "" if column.dtype is np.float64 else f" of {column.dtype.__name__}"
            unit = f" [{column.unit}]" if column.unit else ""
            shape = ("n", *column.row)
            entries += f"{column.name} : ndarray{kind}{unit}, shape {shape}\n".replace("'", "")
            entries += indent(fill(column.meaning, 110), "    ") + "\n"
    # Python 3.13 removes the indentation of docstrings itself
    cls.__doc__ = cleandoc(cls.__doc__ or "").replace("\njournal :", f"\n{entries}journal :", 1)
    return cls


@_with_columns
@dataclass(frozen=True, eq=False, repr=False)
class Batch:
    """A sequence of evaporated atoms: the columns of ``_core/events.pyx``, and what the flights need.

    Parameters
    ----------
    journal : Journal
        Changes of the tree by each event.
    tree : Octree or None
        Copy of the tree before the first event, if it was rebuilt after the previous batch, or long ago.
    status : int
        DONE, SWEEP_DUE, EXHAUSTED or TOO_SHALLOW.
    cap : Cap or None
        The cap before the first event, if the surface was relaxed after the previous batch.
    voltages : ndarray or None
        Voltage of the control at each event [V], shape (n,). As `waits`, None for a law without a temperature.
    columns : dict
        All columns of the events by name, also those without a field here.
    """

    site: np.ndarray
    charges: np.ndarray
    fields: np.ndarray
    normals: np.ndarray
    targets: np.ndarray
    target_charges: np.ndarray
    detached: np.ndarray
    journal: Journal
    tree: Octree | None
    status: int
    cap: Cap | None = None
    waits: np.ndarray | None = None
    voltages: np.ndarray | None = None
    columns: dict[str, np.ndarray] = field(default_factory=dict)

    def __len__(self) -> int:
        return len(self.site)

    def __repr__(self) -> str:
        status = {DONE: "done", SWEEP_DUE: "sweep due", EXHAUSTED: "exhausted", TOO_SHALLOW: "too shallow"}[self.status]
        return f"<Batch: {len(self):,} evaporated atoms; {status}>"


class Emitter:
    """The charged surface of a specimen.

    Parameters
    ----------
    tip : Tip
        The specimen.
    voltage : float
        Applied voltage [V].
    law : law, optional
        Selects the next atom to evaporate; by default `Extremal`. Interface: `evaporation.Law`.
    settings : ChargeSettings
        Accuracy of the charges.
    n_threads : int, optional
        Number of threads; by default the number of processors that this process may use.
    rule : charging rule, optional
        Distribution of the charge over the surface; by default `Robin`. Interface: `evaporation.Rule`.
    control : VoltageControl, optional
        Control of the voltage for a law with a temperature, such as `Arrhenius`. Charges and fields of the emitter
        remain those at `voltage`; the law sees them in proportion to `control_voltage`.
    seed : int
        Seed of the events of a law with a temperature.
    target_shells : int
        1: the targets of a roll-up are nearest neighbours; 2: also second neighbours.

    Raises
    ------
    ValueError
        If the voltage is not positive, `target_shells` is not 1 or 2, or the specimen has no evaporable surface atom.
    """

    def __init__(
        self,
        tip: Tip,
        voltage: float = 1000.0,
        law: Law | None = None,
        settings: ChargeSettings | None = None,
        n_threads: int | None = None,
        rule: rules.Rule | rules.CompiledRule | None = None,
        control: VoltageControl | None = None,
        seed: int = 0,
        target_shells: int = 1,
    ) -> None:
        self.tip = check_kind(tip, "tip", Tip, "a Tip")
        self.voltage = check_voltage(voltage)
        self.law = Extremal() if law is None else law
        check_law(self.law)
        self.rule = rules.Robin() if rule is None else rule
        rules.check_rule(self.rule)
        warn_if_not_for(type(self.rule).__name__, self.law)
        settings = ChargeSettings() if settings is None else settings
        check_kind(settings, "settings", ChargeSettings, "ChargeSettings")
        tolerance, share, whole_interval = rules.relaxations_of(self.rule)
        if settings.tolerance is None:
            settings = replace(settings, tolerance=tolerance)
        if settings.whole_interval is None:
            settings = replace(settings, whole_interval=whole_interval)
        self.settings = settings
        self.n_threads = thread_count(n_threads)
        if control is not None:
            check_kind(control, "control", VoltageControl, "a VoltageControl")
        self._rate_control = RateControl.of(self.law, tip, control) if has_temperature(self.law) else None
        kernel = self._kernel_of(tip)
        distance = tip.nearest_neighbour_distance
        stretch = 1.0
        if check_count(target_shells, "target_shells", at_least=1, at_most=2) == 2:
            structure = tip.elements[0].structure
            reach = SECOND_SHELL_FACTORS[structure] / BOND_FACTORS[structure]
            stretch = reach * reach
        self._core = Evaporation(
            self._neighbourhood_of(tip, kernel),
            rules.kernel_of(self.rule, tip),
            kernel,
            self.voltage / COULOMB,
            COULOMB,
            self.settings.patch_radius * distance,
            self.settings.update_radius * distance,
            self.settings.relaxation_angle,
            self.settings.potential_bound,
            (check_seed(seed) + _SEED_STEP) % (1 << 64),
            self._rate_control,
            stretch,
        )
        self._sites: list[Integers] = []  # evaporated atoms of each batch
        self._extensions: list[int] = []  # number of events before each extension of the shell
        if not tip.evaporable[self._core.atoms.surface].any():
            raise ValueError(f"{tip!r} has no evaporable surface atom")
        self.relax(tolerance=self.settings.start_tolerance)
        if self._core.next_slot < 0:
            raise ValueError(
                f"law {type(self.law).__name__} gives no surface atom of {tip!r} a key > 0: no atom can evaporate"
            )
        self.sweep_interval = self.settings.sweep_interval or max(100, len(self) // share)

    @property
    def control(self) -> VoltageControl | None:
        """Control of the voltage; None for a law without a temperature."""
        return None if self._rate_control is None else self._rate_control.control

    @property
    def pulse_length(self) -> float | None:
        """Time per pulse with the rate of its top [s]; None without pulses."""
        return None if self._rate_control is None else self._rate_control.pulse_length or None

    @property
    def control_voltage(self) -> float:
        """Voltage of the control [V]; without one, the applied voltage of the charges."""
        if self._rate_control is None:
            return self.voltage
        return self.voltage * float(self._rate_control.voltage_factors(self._rate_control.rise))

    def _kernel_of(self, tip):
        return kernel_of(self.law, tip, self.control)

    def _neighbourhood_of(self, tip, kernel, previous=None):
        names = ("neighbour_radius", "surface_threshold", "bond_length")
        if len(set(tip.criteria)) == 1:
            radius, threshold, bond_length = (getattr(tip.criterion, name) for name in names)
            kinds = None
        else:
            radius, threshold, bond_length = (
                np.array([getattr(criterion, name) for criterion in tip.criteria]) for name in names
            )
            kinds = tip.phase
        outer = tip.outer
        return Neighbourhood(
            tip.positions,
            radius,
            threshold,
            tip.support.view(np.int8),
            bond_length,
            usable_threads(self.n_threads),
            previous,
            (tip.support | ~tip.evaporable).view(np.int8),
            kernel.surroundings,
            kinds,
            None if outer is None else outer.view(np.int8),
        )

    def __len__(self) -> int:
        return len(self._core.slots)

    def __reduce__(self):
        raise TypeError("an Emitter cannot be pickled or copied: make a new one and restore its `state()`")

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

    def charge_residuals(self, selection: Integers) -> Floats:
        """Residuals of the equation of the charging rule, by direct sums over all other atoms.

        Parameters
        ----------
        selection : ndarray of int, shape (m,)
            Indices of surface atoms.

        Returns
        -------
        ndarray, shape (m,)
            Residuals relative to the mean charge; NaN for a rule that does not define them.
        """
        return self._core.rule.residuals(self.positions, self.normals, self.charges, selection)

    @property
    def fields(self) -> Floats:
        """Fields just outside the surface atoms [V/nm], shape (n,).

        The input of the law. For Robin's rule F_i = 4 pi k_e q_i / s, with s the area per surface atom: the field at
        the outer side of a charged surface. `ConstantPotential` has a choice.
        """
        return self._core.slot_fields[self._core.slots]

    @property
    def cap(self) -> Cap:
        """Radius and mean field of the cap: see `Cap`."""
        core = self._core
        slots = core.slots
        slots = slots[self.tip.evaporable[core.tree.atoms[slots]]]
        evaporation_fields = self.tip.evaporation_fields[self.tip.species[core.tree.atoms[slots]]]
        return measure_cap(
            core.tree.positions[slots], core.slot_normals[slots], core.slot_fields[slots], evaporation_fields
        )

    @property
    def bonds(self) -> Integers:
        """Number of remaining nearest neighbours of each surface atom, shape (n,)."""
        return self._core.atoms.bond_counts[self.atoms].astype(np.int64)

    def to_atoms(self) -> Any:
        """Return the surface as ase.Atoms [Angstrom]; needs ASE.

        Returns
        -------
        ase.Atoms
            With arrays "charge" [e], "field" [V/nm], "normal" and "atom" (index in the specimen).
        """
        arrays = {"charge": self.charges, "field": self.fields, "normal": self.normals, "atom": self.atoms}
        return to_atoms(self.positions, self.tip.elements, self.tip.species[self.atoms], **arrays)

    @property
    def tree(self) -> Octree:
        """Copy of the octree of the charges, for flights in the present field."""
        return self._core.tree.copy()

    @property
    def area_per_atom(self) -> float:
        """Area s per surface atom at the last relaxation [nm^2]."""
        return self._core.rule.area

    @property
    def counts(self) -> dict[str, int]:
        """Counts of events and atoms.

        "events" and "detached" atoms so far, negative charges set to 0 ("clipped") and patches that did not converge
        ("unsettled") so far, and "negative" charges of the present surface (`ConstantPotential` allows them).
        """
        core = self._core
        counts = {"clipped": core.n_clipped, "unsettled": core.n_unsettled}
        counts["negative"] = 0 if core.tree is None else int((core.tree.charges < 0).sum())
        return {"events": core.n_removed, "detached": core.atoms.n_detached, **counts}

    def field_at(self, points: ArrayLike, opening_angle: float = 0.3) -> Floats:
        """Electric field of the surface charges.

        Parameters
        ----------
        points : array_like, shape (m, 3)
            Positions [nm].
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
        """Solve the charges of the whole surface at the applied voltage.

        Parameters
        ----------
        tolerance : float, optional
            Largest change of a charge in the last sweep, relative to the mean charge. By default `tolerance` of the
            settings, with their `relaxation_angle`; a value passed here is used with the smaller `opening_angle`.

        Returns
        -------
        sweeps : int
            Number of sweeps.
        residual : float
            Largest change in the last sweep, relative to the mean charge.
        """
        angle = self.settings.relaxation_angle if tolerance is None else self.settings.opening_angle
        tolerance = self.settings.tolerance if tolerance is None else tolerance
        tolerance = check_number(tolerance, "tolerance", above=0, at_most=1)
        return self._relax(tolerance, angle)

    def relax_due(self) -> tuple[int, float]:
        """Relax what `advance` relaxes when it is due: the surroundings of the holes, or the whole surface.

        The whole surface is relaxed every `whole_interval` times, when its tree has no space for further atoms, and
        when the charges far from the holes have changed by more than 1.5e-3. See `relax` for the results.
        """
        core, settings = self._core, self.settings
        tolerance = check_number(settings.tolerance, "tolerance", above=0, at_most=1)
        whole_interval = check_count(settings.whole_interval, "whole_interval", at_least=1)
        if core.whole_is_due or core.n_partial + 1 >= whole_interval or tolerance < _SINGLE:
            return self.relax()
        outcome = core.relax_disturbed(tolerance=tolerance, n_threads=usable_threads(self.n_threads))
        return self.relax() if core.whole_is_due else self._converged(outcome, tolerance)

    def _relax(self, tolerance, angle, start=None):
        counts = self.counts
        outcome = self._core.relax(
            tolerance=tolerance,
            opening_angle=angle,
            double_precision=tolerance < _SINGLE,
            n_threads=usable_threads(self.n_threads),
            start=start,
        )
        self._relaxed = (tolerance, angle, counts["clipped"], counts["unsettled"], self._core.control.voltage_factor)
        return self._converged(outcome, tolerance)

    def _converged(self, outcome, tolerance):
        self._recorded, self._is_new = RECORD, True
        if not outcome[1] < tolerance:
            warn(
                f"charges did not converge in {outcome[0]} sweeps: largest relative change {outcome[1]:.1g} "
                f"(tolerance {tolerance:.1g})",
                ChargesWarning,
            )
        return outcome

    def state(self) -> EmitterState:
        """State from which the surface after the last relaxation of the whole surface can be rebuilt.

        Returns
        -------
        EmitterState
        """
        start = self._core.start
        sites = np.concatenate([np.empty(0, np.int64), *self._sites])
        self._sites = [sites]
        tolerance, angle, clipped, unsettled, voltage_factor = self._relaxed
        return EmitterState(
            sites=sites[: start.n_removed],
            charges=start.charges,
            isolated=start.isolated,
            isolated_normals=start.isolated_normals,
            extensions=tuple(self._extensions),
            tolerance=tolerance,
            opening_angle=angle,
            clipped=clipped,
            unsettled=unsettled,
            rule_state=start.rule_state,
            voltage_factor=voltage_factor,
        )

    def restore(self, state: EmitterState) -> None:
        """Rebuild the surface of another emitter with the same settings.

        Parameters
        ----------
        state : EmitterState
            State of the other emitter: its surface after its last relaxation of the whole surface, from which events
            continue.

        Raises
        ------
        ValueError
            If atoms have already evaporated, or if the state is of another specimen.
        """
        if self.counts["events"]:
            raise ValueError(f"restore needs a new emitter, got one with {self.counts['events']:,} evaporated atoms")
        first = 0
        for event in state.extensions:
            self._core.atoms.remove_atoms(state.sites[first:event])
            self._extend_specimen()
            first = event
        self._core.atoms.remove_atoms(state.sites[first:])
        exposed = np.isin(state.isolated, self._core.atoms.surface)
        if not exposed.all() or len(exposed) != len(state.isolated_normals):
            raise ValueError("isolated must be surface atoms, each with a normal: the state is of another specimen")
        self._sites, self._extensions = [state.sites], list(state.extensions)
        self._core.n_clipped, self._core.n_unsettled = state.clipped, state.unsettled
        self._core.control.voltage_factor = state.voltage_factor
        start = RelaxationStart(
            len(state.sites), state.charges, state.isolated, state.isolated_normals, state.rule_state
        )
        self._relax(state.tolerance, state.opening_angle, start)

    def remove(self, sites: Integers) -> None:
        """Remove atoms as if they had evaporated, and relax the whole surface.

        Parameters
        ----------
        sites : ndarray of int, shape (n,)
            Atoms in the order of their removal.
        """
        sites = np.ascontiguousarray(sites, np.int64)
        self._core.remove(sites)
        self._sites.append(sites)
        self.relax()

    def request_tree_copy(self) -> None:
        """Add a copy of the tree to the next batch, for flights that have not followed the earlier events."""
        self._recorded = RECORD

    def request_cap(self) -> None:
        """Add the cap to the next batch, at the beginning of a run."""
        self._is_new = True

    def extend_shell(self) -> None:
        """Extend the shell of the specimen, after `evaporate` reached its support atoms.

        The atoms of the previous shell keep their numbers.

        Raises
        ------
        ValueError
            If the specimen is not a shell, such as one made from positions.
        """
        self._extend_specimen()
        self._extensions.append(self._core.n_removed)
        self.relax()

    def _extend_specimen(self):
        tip = self.tip.deepened()
        kernel = self._kernel_of(tip)
        self._core.replace_atoms(self._neighbourhood_of(tip, kernel, self._core.atoms), kernel)
        self.tip = tip

    def evaporate(self, max_events: int) -> Batch:
        """Evaporate up to `max_events` atoms.

        Stops early if the surface must be relaxed, the shell extended, or no atom is left; `advance` does this by
        itself.

        Parameters
        ----------
        max_events : int
            Maximum number of events.

        Returns
        -------
        Batch
            Its status is the reason for its end: DONE, SWEEP_DUE (call `relax_due` and continue), EXHAUSTED or
            TOO_SHALLOW (call `extend_shell` and continue).
        """
        n = check_count(max_events, "max_events", at_least=1, at_most=_MAX_EVENTS)
        events, control = Events(self.tip.positions, n), self._rate_control
        tree = self._core.tree.copy() if self._recorded >= RECORD else None
        cap, self._is_new = self.cap if self._is_new else None, False
        status = self._core.evaporate(events, self.sweep_interval)
        n = events.journal.n_events
        self._recorded = n if tree is not None else self._recorded + n
        columns = events.columns()
        self._sites.append(columns["site"].copy())
        fields = {name: values for name, values in columns.items() if name in Batch.__annotations__}
        if control is None:
            fields["waits"] = None
        return Batch(
            **fields,
            journal=events.journal,
            tree=tree,
            status=status,
            cap=cap,
            voltages=None if control is None else self.voltage * control.voltage_factors(columns["rises"]),
            columns=columns,
        )

    def advance(
        self,
        n_events: int,
        batch_size: int = BATCH,
        pause: Callable[[], AbstractContextManager[Any]] = nullcontext,
    ) -> Iterator[Batch]:
        """Evaporate atoms batch by batch; relax the surface and extend the shell between the batches.

        Parameters
        ----------
        n_events : int
            Number of atoms to evaporate.
        batch_size : int
            Events per batch; the sequence does not depend on it.
        pause : callable, optional
            Returns a context in which the surface is relaxed or the shell extended. Other work that needs the
            processors, or the unchanged specimen, must stop in this context.

        Yields
        ------
        Batch
            May be empty. The relaxation or extension follows when the next batch is requested, so that the surface can
            be inspected before. The last batch is EXHAUSTED if no atom is left.
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
                    self.relax_due() if batch.status == SWEEP_DUE else self.extend_shell()
