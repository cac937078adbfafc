"""A run: the sequence of evaporated atoms and the hit positions of their ions for any perturbation; saved in HDF5."""

import hashlib
import json
import warnings
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from apt_evap._common.files import FileError, check_path
from apt_evap._common.types import AnyPath, Booleans
from apt_evap._common.validation import check_kind, check_switch, short_text
from apt_evap._common.warnings import DataWarning
from apt_evap.detection.detector import Detector
from apt_evap.detection.hits import Hits
from apt_evap.emission.emissions import COLUMNS, Emissions
from apt_evap.emission.ion_random import IonRandom
from apt_evap.emission.perturbations import Perturbation, Unperturbed
from apt_evap.evaporation.state import EmitterState
from apt_evap.flight.response import ResponseModel, Responses, ResponseSettings
from apt_evap.simulation.ending import Ending
from apt_evap.simulation.history import History
from apt_evap.simulation.provenance import joined, provenance_now
from apt_evap.simulation.run_hdf5 import described, read_run, write_run


@dataclass(frozen=True, eq=False)
class Flown:
    """Results of the flights of one perturbation: stereographic directions (n, 2) and times of flight (n,) [ns]."""

    directions: np.ndarray
    times: np.ndarray

    def __repr__(self) -> str:
        return f"<Flown: directions and times of {len(self.times):,} ions>"


@dataclass(frozen=True, eq=False, repr=False)
class Run:
    """Sequence of evaporated atoms, with the data for the hit positions of their ions.

    Returned by `Simulation.run` and `load`.

    Parameters
    ----------
    emissions : Emissions
        Sites, normals, neighbours, charge states, masses and numbers of the n ions.
    site : ndarray of int64, shape (n,)
        Index of each atom in the specimen.
    species : ndarray of int32, shape (n,)
        Index of each atom into `elements`.
    charges, fields : ndarray, shape (n,)
        Charge [e] and field just outside [V/nm] of each atom before it evaporated.
    perturbations : tuple
        Perturbations flown in the run; a user-defined one is its description if the run was loaded from a file.
    flown : tuple of Flown
        Results of each of these perturbations.
    responses : Responses or None
        Response polynomials of every ion.
    seed : int
        Seed of the random numbers of the perturbations.
    voltage : float
        Applied voltage [V].
    detector : Detector
        The detector.
    response_settings : ResponseSettings
        Settings of the responses.
    elements : tuple of str
        Names of the species.
    settings : dict
        All settings of the run, in plain types.
    history : History
        Results of the checks during the run.
    state : EmitterState or None
        State of the emitter at the last relaxation of the run, from which the run can be resumed.
    first_event : int
        Number of atoms that evaporated before the first ion of the run.
    ended : str
        Reason if the run ended early; otherwise "".
    provenance : dict
        Version, time, and under "systems" the processors and libraries of the computation.
    detached : ndarray of bool, shape (n,), optional
        Atoms that left because they had lost all chains of bonds to the body; by default none, as in files of earlier
        versions.
    """

    emissions: Emissions
    site: np.ndarray
    species: np.ndarray
    charges: np.ndarray
    fields: np.ndarray
    perturbations: tuple
    flown: tuple
    responses: Responses | None
    seed: int
    voltage: float
    detector: Detector
    response_settings: ResponseSettings
    elements: tuple
    settings: dict
    history: History = field(default_factory=History.empty)
    state: EmitterState | None = None
    first_event: int = 0
    ended: str = ""
    provenance: dict = field(default_factory=provenance_now)
    detached: Any = None

    def __post_init__(self):
        if self.detached is None:
            object.__setattr__(self, "detached", np.zeros(len(self.site), bool))

    def __len__(self) -> int:
        return len(self.site)

    def __repr__(self) -> str:
        flown = ", ".join(_describe(perturbation) for perturbation in self.perturbations)
        responses = "" if self.responses is None else f"responses, {self.flagged.sum():,} of them flagged"
        details = "; ".join(part for part in (responses, flown and f"flown: {flown}", self.ended) if part)
        return f"<Run: {len(self):,} ions of {', '.join(self.elements)} at {self.voltage:g} V; {details}>"

    @property
    def response_model(self) -> ResponseModel:
        """Launches, fit and evaluation of the responses."""
        return ResponseModel(self.response_settings, self.detector)

    @property
    def flagged(self) -> Booleans:
        """Ions whose responses deviate from their own flights by more than the bound, or have no fit, bool (n,)."""
        if self.responses is None:
            return np.zeros(len(self), bool)
        return self.response_model.flagged(self.responses, self.emissions.can_roll)

    @property
    def first_perturbation(self) -> Any:
        """The first perturbation flown in the run; `Unperturbed` if there are only responses."""
        return self.perturbations[0] if self.flown else Unperturbed()

    def fingerprint(self) -> str:
        """Hash of all results, to compare runs.

        Returns
        -------
        str
            SHA-256 over the names, types and values of the columns: emissions, sites, species, charges, fields, flown
            perturbations and responses. By design it does not depend on the machine.
        """
        columns = {name: getattr(self, name) for name in ("site", "species", "charges", "fields")}
        columns |= {f"emissions/{name}": getattr(self.emissions, name) for name in COLUMNS}
        for number, flown in enumerate(self.flown):
            columns |= {f"flown/{number}/directions": flown.directions, f"flown/{number}/times": flown.times}
        if self.responses is not None:
            columns |= {f"responses/{name}": values for name, values in self.responses._asdict().items()}
        hashed = hashlib.sha256()
        for name in sorted(columns):
            values = np.array(columns[name], order="C")
            if values.dtype.kind == "f":
                values[np.isnan(values)] = np.nan  # NaN has many bits, which depend on the processor
            values = values.astype(values.dtype.newbyteorder("<"), copy=False)
            hashed.update(f"{name} {values.dtype.str} {values.shape}\n".encode())
            hashed.update(values.data)
        return hashed.hexdigest()

    def hits(self, perturbation: Perturbation, *, by_response: bool = False) -> Hits:
        """Hits of the ions for a perturbation.

        For a perturbation that was flown in the run, the results of these flights are used. Any other perturbation that
        launches along the surface (all built-in ones, with any energies) is evaluated from the responses. Each ion has
        the same random numbers for every perturbation.

        Parameters
        ----------
        perturbation : perturbation
            Initial conditions of the ions.
        by_response : bool
            Whether to use the responses even for a perturbation that was flown, for comparison.

        Returns
        -------
        Hits
            One row per ion, in the sequence of evaporation; `outcome` is the outcome of each flight.

        Raises
        ------
        ValueError
            If the perturbation was not flown and cannot be evaluated from the responses.
        """
        check_switch(by_response, "by_response")
        for flown_as, flown in zip(self.perturbations, self.flown, strict=True):
            known = flown_as == perturbation or flown_as == described(perturbation)  # by name and repr in a file
            if known and not by_response:
                return self._hits(flown.directions, flown.times, perturbation)
        if not callable(getattr(perturbation, "tangential", None)):
            check_kind(perturbation, "perturbation", "launch", "a perturbation such as Unperturbed() or RollUp(0.2)")
            raise ValueError(
                f"perturbation {short_text(perturbation)} was not flown in this run and has no method `tangential`; "
                "pass it to the simulation: simulation.run(n, emissions=[...])"
            )
        if self.responses is None:
            raise ValueError(f"this run has no responses and {short_text(perturbation)} was not flown in it")
        emissions = self.emissions
        rolled, first, second = perturbation.tangential(emissions, IonRandom(self.seed, emissions.ions))  # type: ignore[attr-defined]
        landed = self.response_model.evaluate(self.responses, rolled, first, second, emissions.masses)
        return self._hits(*landed, perturbation)

    def _hits(self, directions, times, perturbation):
        x, y, times, outcome = self.detector.impacts(directions, times)
        emissions = self.emissions
        return Hits(
            x=x,
            y=y,
            time_of_flight=times,
            voltage=np.full(len(self), self.voltage),
            mass_to_charge=emissions.masses / emissions.charge_states,
            positions=emissions.positions,
            site=self.site,
            ion=emissions.ions,
            outcome=outcome,
            extra={"charge": self.charges, "field": self.fields},
            units={"charge": "e", "field": "V/nm"},
            source=f"simulation, {_describe(perturbation)}",
            extent=self.detector.extent,
        )

    def seen_by(self, detector: Detector) -> "Run":
        """The same ions, recorded by another detector.

        Parameters
        ----------
        detector : Detector
            Detector with another distance, width or projection.

        Returns
        -------
        Run
        """
        return replace(self, detector=detector, settings=self.settings | {"detector": vars(detector)})

    def summary(self) -> dict[str, Any]:
        """Counts, dict: ions, outcomes of the first perturbation, ions that cannot roll up, flagged ions."""
        first = self.first_perturbation
        counts = {outcome.name.lower(): count for outcome, count in self.hits(first).counts.items()}
        return {
            "ions": len(self),
            "perturbation": _describe(first),
            **counts,
            "without_neighbour": int((~self.emissions.can_roll).sum()),
            "detached": int(self.detached.sum()),
            "flagged": int(self.flagged.sum()),
            "ended": self.ended,
        }

    # ---- parts -----------------------------------------------------------------------------------------------------

    @classmethod
    def join(cls, runs: "Sequence[Run]") -> "Run":
        """Join the parts of one run in their order."""
        first = runs[0]
        emissions = Emissions.join([run.emissions for run in runs])
        columns: dict[str, Any] = {
            name: np.concatenate([getattr(run, name) for run in runs])
            for name in ("site", "species", "charges", "fields", "detached")
        }
        flown = tuple(
            Flown(
                np.concatenate([part.directions for part in parts]),
                np.concatenate([part.times for part in parts]),
            )
            for parts in zip(*(run.flown for run in runs), strict=True)
        )
        responses = None
        if first.responses is not None:
            responses = Responses(
                *(np.concatenate(parts) for parts in zip(*(run.responses for run in runs), strict=True))
            )
        history = History.join([run.history for run in runs])
        columns["provenance"] = joined([run.provenance for run in runs])
        return replace(first, emissions=emissions, flown=flown, responses=responses, history=history, **columns)  # type: ignore[arg-type]

    def ended_by(self, reason: str) -> "Run":
        """The same run with the reason of an early end."""
        return replace(self, ended=reason)

    # ---- files -----------------------------------------------------------------------------------------------------

    def save(self, path: AnyPath) -> None:
        """Write the run to an HDF5 file. The file is either complete or absent.

        Parameters
        ----------
        path : str or path-like
            The file to write or overwrite.

        Raises
        ------
        FileError
            If it cannot be written.
        """
        write_run(path, self)


def load(path: AnyPath, *, partial: bool = False) -> Run:
    """Read a run from an HDF5 file of `Run.save`, or from the folder of an unfinished run.

    Parameters
    ----------
    path : str or path-like
        The file; or the folder beside it, whose name ends in ".unfinished" (see `Checkpoint`).
    partial : bool
        Whether to read the undamaged ions of a damaged file or folder; a warning gives the number of lost ions.

    Returns
    -------
    Run

    Raises
    ------
    FileError
        If it is missing, unreadable, damaged or not a run.
    """
    path = check_path(path)
    if path.is_dir():
        return _load_parts(path, partial)
    return _load_file(path, partial)


def _load_file(path, partial=False):
    arguments = read_run(path, partial)
    return Run(**arguments | {"flown": tuple(Flown(*flown) for flown in arguments["flown"])})


def _load_parts(folder, partial):
    parts, names = [], []
    for path in part_paths(folder):
        try:
            part = _load_file(path, partial)
        except FileError as error:
            if not partial:
                raise
            warnings.warn(f"{error}: its ions are lost", DataWarning, stacklevel=3)
            continue
        if parts and (name := _difference(parts[0], part)):
            raise FileError(f"{str(path)!r} belongs to another run than {names[0]!r}: its {name} differ")
        parts.append(part)
        names.append(path.name)
    if not parts:
        raise FileError(f"{str(folder)!r} contains no run: expected files {PART_NAME.format(0)!r} and so on")
    return Run.join(parts).ended_by(Ending.UNFINISHED)


def _difference(one, other):
    """Name of the first property that differs between two parts of one run; "" if there is none."""
    pairs = {
        "settings": (one.settings, other.settings),
        "elements": (one.elements, other.elements),
        "perturbations": tuple([described(each) for each in run.perturbations] for run in (one, other)),
        "responses": (one.responses is None, other.responses is None),
    }
    return next((name for name, (first, second) in pairs.items() if first != second), "")


PART_NAME = "ions-{:012d}.h5"


def part_paths(folder: Path) -> list[Path]:
    """Files of an unfinished run in the order of their ions."""
    return sorted(folder.glob("ions-*.h5"))


def _describe(perturbation):
    return perturbation.get("repr", json.dumps(perturbation)) if isinstance(perturbation, dict) else repr(perturbation)
