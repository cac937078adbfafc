"""A run: what evaporated, what an instrument sees of it, its parts and its files.

The table is in `apt_evap.simulation.run_table`; the other modules, of one of these each, import that.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from apt_evap._common.codec import changed
from apt_evap._common.types import AnyPath, Floats, Integers
from apt_evap._common.validation import check_kind, check_seed, check_sequence
from apt_evap.detection.detector import Detector
from apt_evap.detection.detector_map import DetectorMap
from apt_evap.detection.hits import Hits
from apt_evap.detection.instrument import Instrument
from apt_evap.detection.microscope.local_electrode import LocalElectrode
from apt_evap.emission.perturbations import Perturbation, perturbation_text
from apt_evap.simulation.observation import Observation, behind, on_detector
from apt_evap.simulation.parts_of_runs import join_parts, select_rows
from apt_evap.simulation.real_units import OperatingPoint, RealUnits, real_units_of
from apt_evap.simulation.run_hdf5 import read_run, write_run
from apt_evap.simulation.run_table import RunTable
from apt_evap.simulation.stop_reason import StopReason

if TYPE_CHECKING:
    from apt_evap.measures.point_cloud import PointCloud


@dataclass(frozen=True, eq=False, repr=False)
class Run(RunTable):
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
        Atoms that left because they had lost all chains of bonds to the body; by default none.
    phase : ndarray of int8, shape (n,), optional
        Index of the phase of each atom into `phase_names`; by default 0.
    cap : CapHistory
        The cap of the surface after each relaxation, at the simulated voltage.
    clock : Clock or None
        Time and voltage of each event, for a law with a temperature.
    events : dict
        Columns of the events that have no field here, by name, see ``simulation/columns.py``.
    units : RealUnits or None
        Operating point of a run in real units, see `at_evaporation_field`.
    real : RealColumns or None
        Its voltages, charges, masses and pulses.

    Examples
    --------
    >>> run = ae.Simulation(ae.Tip("Ni", apex_radius=2.0, axis=(1, 1, 1)), seed=1).run(100)
    >>> run.hits(ae.RollUp(0.2))  # any perturbation, without new flights
    <Hits: 100 ions, 99 detected from 'simulation, RollUp(0.2)'; x, y, time_of_flight, ...>
    >>> real = run.at_evaporation_field()
    >>> print(f"{real.voltages[0]:.0f} V")
    81 V
    """

    def __getitem__(self, rows: Any) -> "Run":
        """Part of the run: only the selected ions, as if the others had not been recorded.

        Parameters
        ----------
        rows : slice or array_like
            A slice, a mask or indices. The rows stay in the sequence of evaporation, each at most once.

        Returns
        -------
        Run
            With the history of the whole run. Voltages in real units stay those of the whole run if it has them;
            `at_evaporation_field` of the part averages over the selected ions only. `pulses` and `multiplicity` of hits
            count the selected ions.

        Raises
        ------
        ValueError
            If `rows` is of another kind, or in another order.
        IndexError
            If a row does not exist, or a mask has another length than the run.
        """
        return replace(self, **select_rows(self, rows))

    @property
    def voltages(self) -> Floats:
        """Voltage at each event [V], shape (n,): constant, that of the control, or in real units that of the model.

        With voltage pulses it is the voltage at the top of the pulse.
        """
        return self.observation.operating.voltages

    @property
    def instrument_voltages(self) -> Floats:
        """Voltage between specimen and electrode at each event [V], shape (n,), at the top of the pulse."""
        return self.observation.operating.instrument_voltages

    @property
    def flight_charges(self) -> Integers:
        """Charge of each ion in flight [e], shape (n,); without real units that at the barrier."""
        return self.observation.operating.charges

    @property
    def energy_scales(self) -> Floats:
        """Simulated energy per energy of this run, n V of the simulation over n V in flight, shape (n,).

        1 without real units: energies are those at the simulated voltage and the charge at the barrier.
        """
        return self.observation.operating.energy_scales

    # ---- observation -----------------------------------------------------------------------------------------------

    @cached_property
    def observation(self) -> Observation:
        """What an instrument sees of the run: voltages, lens, detector and field of view."""
        return Observation(RunTable(**self.__getstate__()))  # of the run itself, both would wait for the collector

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
            One row per ion, in the sequence of evaporation; `outcome` is the outcome of each flight. ``extra`` contains
            the element of each ion, its charge and field before evaporation, and the name of its phase if there are
            several.

        Raises
        ------
        ValueError
            If the perturbation was not flown and cannot be evaluated from the responses.
        """
        return self.observation.hits(perturbation, by_response)

    def sites(self) -> "PointCloud":
        """True sites of the ions in the specimen, with z out of it, and their elements: for measures of the truth.

        Returns
        -------
        PointCloud

        Examples
        --------
        >>> tip = ae.Tip("Ni", apex_radius=2.0, axis=(1, 1, 1), solutes={"Al": 0.1}, seed=1)
        >>> ae.Simulation(tip, seed=1).run(100).sites()
        <PointCloud: 100 ions from 'sites of the run', 3.9 x 4.0 x 3.5 nm; Ni 51, Al 49>
        """
        from apt_evap.measures.point_cloud import PointCloud  # a map must not wait for it

        names = tuple(dict.fromkeys(self.elements))  # phases may share an element
        number = np.array([names.index(element) for element in self.elements])
        return PointCloud(self.emissions.positions, number[self.species], names, source="sites of the run")

    def places(
        self, perturbation: Perturbation, *, by_response: bool = False
    ) -> tuple[Floats, Floats, NDArray[np.int8]]:
        """Positions of the hits alone, the same as those of `hits`.

        Parameters
        ----------
        perturbation, by_response
            As for `hits`.

        Returns
        -------
        x, y : ndarray, shape (n,)
            Detector coordinates [mm].
        outcome : ndarray of int8, shape (n,)
            `Outcome` of each ion.

        Raises
        ------
        ValueError
            As for `hits`.
        """
        return self.observation.places(perturbation, by_response)

    def grid(self, bins: int) -> DetectorMap:
        """Empty map of the complete detector, for the `like` of maps of this run.

        Parameters
        ----------
        bins : int
            Number of bins along each side.

        Returns
        -------
        DetectorMap
            Without hits. Bins outside the field of view of the flights are outside its mask.
        """
        return self.observation.grid(bins)

    def at_evaporation_field(
        self, lens: LocalElectrode | None = None, point: OperatingPoint | None = None, **arguments: Any
    ) -> "Run":
        r"""The same run in real units: at the voltages that bring it to its evaporation field.

        Energies of perturbations are then true eV, `voltages` true V and times of flight true ns. Nothing is simulated
        again.

        Parameters
        ----------
        lens : LocalElectrode, optional
            Lens of specimen, shank and electrode. Voltages, positions of hits and times of flight are then those of the
            instrument, as its voltage and its image compression follow the radius of the cap; see `on_detector`.
        point : OperatingPoint, optional
            Operating field, charges in flight, pulses and errors of the times; by default `OperatingPoint()`.
        **arguments
            Fields of `OperatingPoint` that replace those of `point`: ``run.at_evaporation_field(field_factor=3.3)``.

        Returns
        -------
        Run
            With voltages, charges, isotopes and pulses of each ion in `real`, and the operating point in `units`.

        Raises
        ------
        ValueError
            If an argument is outside its range, the run does not contain the fields of its cap, or a lens is given for
            a specimen that is not a cap on a shank.

        Notes
        -----
        All fields are proportional to the voltage. With the field :math:`F_i` at the simulated voltage :math:`V`, the
        ion i has the voltage

        .. math:: V_i = V \, \frac{x \, F_\mathrm{evap}}{F_i}

        with the operating field :math:`x F_\mathrm{evap}`, averaged over the last ions. Evaporation fields are those of
        the species, also for a law with bonds. The path depends on
        :math:`E_\perp / (n V)` only, and the time of flight is proportional to :math:`\sqrt{m / (n V)}`.
        """
        if point is not None:
            check_kind(point, "point", OperatingPoint, "an OperatingPoint")
        run = self if lens is None else behind(self, lens)
        units, real = real_units_of(run, changed(point or OperatingPoint(), arguments))
        return replace(run, units=units, real=real)

    def simulated(self) -> "Run":
        """The same run without real units, at the simulated voltage."""
        return replace(self, units=None, real=None)

    def in_real_units(self) -> "Run":
        """The same run in real units: itself if it is, otherwise at its evaporation field."""
        return self.at_evaporation_field() if self.units is None else self

    def require_real_units(self, what: str) -> RealUnits:
        """Operating point of a run in real units; ValueError, which begins with `what` needs it, for any other."""
        return self.observation.operating.require_units(what)

    def on_detector(self, detector: Detector, lens: LocalElectrode | None = None) -> "Run":
        """The same ions on another detector.

        Parameters
        ----------
        detector : Detector
            Detector with another distance, width or projection. Outside the field, the time of flight is proportional
            to the distance.
        lens : LocalElectrode, optional
            Lens in front of the specimen; by default that of the run, if it has one. The angle of the simulated flight
            is traced back to the cap by the free specimen, and from there to the detector by the lens. Ions that the
            electrode stops miss the detector.

        Returns
        -------
        Run

        Raises
        ------
        ValueError
            If the specimen is not a cap on a shank, or the lens has a potential of the detector and the run is not in
            real units, so that its voltages are not known.
        """
        return on_detector(self, detector, lens)

    def record(
        self, instrument: Instrument, perturbation: Perturbation | None = None, *, seed: int | None = None
    ) -> Hits:
        """Ions that an instrument records.

        Parameters
        ----------
        instrument : Instrument
            The instrument, which records the ions of a run in real units.
        perturbation : perturbation, optional
            Initial conditions of the ions; by default the first perturbation flown in the run, or `Unperturbed`.
        seed : int, optional
            Seed of the random numbers of the instrument; by default that of the run.

        Returns
        -------
        Hits
            What the instrument writes, and the truth: `site`, `ion`, `positions`, and in `extra` the species, the phase
            if there are several, the charge in flight, and charge and field before evaporation.

        Raises
        ------
        ValueError
            If the run is not in real units.
        """
        return self.observation.record(
            instrument,
            self.first_perturbation if perturbation is None else perturbation,
            self.seed if seed is None else check_seed(seed),
        )

    def summary(self) -> dict[str, Any]:
        """Counts, dict: ions, outcomes of the first perturbation, ions that cannot roll up, flagged ions.

        With a field of view, also the ions outside it, and those of them that were not flown.
        """
        first = self.first_perturbation
        counts = {outcome.name.lower(): count for outcome, count in self.hits(first).counts.items()}
        if self.field_of_view is None:
            del counts["outside"]
        else:
            counts |= {"not_flown": int(self.not_flown.sum())}
        return {
            "ions": len(self),
            "perturbation": perturbation_text(first),
            **counts,
            "without_neighbour": int((~self.emissions.can_roll).sum()),
            "detached": int(self.detached.sum()),
            "flagged": int(self.flagged.sum()),
            "ended": self.ended,
        }

    # ---- parts -----------------------------------------------------------------------------------------------------

    @classmethod
    def join(cls, runs: "Sequence[Run]") -> "Run":
        """Join the parts of one run.

        Parameters
        ----------
        runs : sequence of Run
            At least one part, in the sequence of evaporation. Ions may be missing between them.

        Returns
        -------
        Run
            With the state and the end of the first part.

        Raises
        ------
        ValueError
            If there is no part, the parts belong to different runs, or their ions do not follow one another.
        """
        runs = check_sequence(runs, "runs", "parts of a run")
        for number, run in enumerate(runs):
            check_kind(run, f"runs[{number}]", Run, "a Run")
        joined = join_parts(runs)
        return replace(runs[0], **joined)

    def unless_interrupted(self) -> "Run":
        """The run itself, for a step that needs all of its ions.

        Raises
        ------
        KeyboardInterrupt
            If Ctrl-C ended the run.
        """
        if self.ended == StopReason.INTERRUPTED:
            raise KeyboardInterrupt
        return self

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


def load(path: AnyPath) -> Run:
    """Read a run from an HDF5 file of `Run.save`, or from that of an unfinished run.

    Parameters
    ----------
    path : str or path-like
        The file; or the one beside it, whose name ends in ".unfinished" (see `Checkpoint`).

    Returns
    -------
    Run

    Raises
    ------
    FileError
        If it is missing, unreadable, damaged or not a run.

    Examples
    --------
    >>> run = ae.Simulation(ae.Tip("Ni", apex_radius=2.0, axis=(1, 1, 1)), seed=1).run(100)
    >>> run.save("ni111.h5")
    >>> ae.load("ni111.h5")
    <Run: 100 ions of Ni at 1000 V; responses, 0 of them flagged>
    """
    return Run(**read_run(path))
