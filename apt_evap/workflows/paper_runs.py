"""Runs for the figures of Shaikh et al. (2025): specimens, sizes, times, and files that are made once."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from apt_evap._common.files import replace_file
from apt_evap.emission.energies import TruncatedNormal
from apt_evap.emission.perturbations import LateralVelocity, Perturbation, RollUp
from apt_evap.simulation.config.cost_estimate import estimate_cost
from apt_evap.simulation.config.simulation_file import read_config
from apt_evap.simulation.run import Run, load
from apt_evap.simulation.run_hdf5 import is_run
from apt_evap.workflows.advice import advice_as_notes
from apt_evap.workflows.simulate_file import simulate

RUNS = "runs"
"""Folder of the runs and their settings."""


@dataclass(frozen=True)
class PaperCase:
    """A metal of the paper, with the energies that were found there.

    Parameters
    ----------
    element : str
        The metal.
    axis : tuple of int
        Crystal direction along the axis.
    mechanism : str
        "lateral" or "roll-up".
    mean, relative_spread : float
        Mean [eV] and standard deviation over the mean, before the truncation.
    """

    element: str
    axis: tuple[int, int, int]
    mechanism: str
    mean: float
    relative_spread: float

    @property
    def name(self) -> str:
        """Such as Al[012]."""
        return f"{self.element}[{''.join(map(str, self.axis))}]"

    @property
    def perturbation(self) -> Perturbation:
        """With the energies of the paper."""
        energy = TruncatedNormal(self.mean, self.relative_spread * self.mean)
        return LateralVelocity(energy) if self.mechanism == "lateral" else RollUp(energy)


ALUMINIUM = PaperCase("Al", (0, 1, 2), "lateral", 0.3, 0.316)
NICKEL = PaperCase("Ni", (1, 1, 1), "roll-up", 0.155, 1.0)


@dataclass(frozen=True)
class PaperSize:
    """Size of the simulations.

    Parameters
    ----------
    name : str
        "quick" or "full".
    radius, blunt_radius : int
        Apex radii in lattice constants; the blunt tip is that of figure 7.
    ions : int
        Ions of each run with responses.
    line_ions : int
        Ions of the sharp tip in figure 7; the blunt one evaporates to the same depth over its radius.
    bins, resamples : int
        Of the fits.
    fit_minutes : float
        Processor time of the three fits with the pictures [min]: of the quick size 45 s (AMD EPYC), the 138 s of all
        figures less those of the runs; of the full size not measured but scaled by the number of ions.
    """

    name: str
    radius: int
    blunt_radius: int
    ions: int
    line_ions: int
    bins: int
    resamples: int
    fit_minutes: float

    @property
    def blunt_ions(self) -> int:
        """Ions of the blunt tip."""
        return round(self.line_ions * (self.blunt_radius / self.radius) ** 3)


QUICK = PaperSize("quick", 20, 30, 15_000, 15_000, 48, 50, 0.75)
FULL = PaperSize("full", 80, 120, 400_000, 237_000, 128, 200, 21.0)


@dataclass(frozen=True)
class PaperRun:
    """One of the runs.

    Parameters
    ----------
    case : PaperCase
        Metal and axis.
    role : str
        "run", "twin", which takes the place of a measurement, or "blunt".
    """

    case: PaperCase
    role: str

    def file(self, size: PaperSize) -> str:
        """Name of the file of the run."""
        radius = size.blunt_radius if self.role == "blunt" else size.radius
        return f"{self.case.element}_{self.role}_R{radius}a.h5"

    def settings(self, size: PaperSize) -> str:
        """Settings file of the run."""
        blunt, seed = self.role == "blunt", 2 if self.role == "twin" else 1
        radius, ions = (size.blunt_radius, size.blunt_ions) if blunt else (size.radius, size.ions)
        energy = f"{self.case.mean:g},{self.case.relative_spread * self.case.mean:g}"
        kind = "LateralVelocity" if self.case.mechanism == "lateral" else "RollUp"
        title, perturbation = (self.case.mechanism, f"{kind}:{energy}") if blunt else ("unperturbed", "Unperturbed")
        return f"""\
# Made by apt-evap paper: {self.case.name}, {self.role}. The detector, voltage and shank are those of the paper.
[tip]
material = "{self.case.element}"
axis = {list(self.case.axis)}
apex_radius = "{radius} a"
shank_length = "{2 * radius} a"
shank_angle = 1.5
offset_seed = {seed}    # the origin of the lattice: another specimen for another seed
depth = "10 a"

[simulation]
ions = {ions}
voltage = 1000.0
seed = {seed}
responses = {"false" if blunt else "true"}

[detector]
distance = 100.0
width = 300.0

[maps]
bins = 160
smoothing = 2.0

[[maps.panels]]
title = "{title}"
perturbation = "{perturbation}"
"""


_NEEDED = {  # runs of each figure; figure 2 has its own specimens, of a few events
    3: ((ALUMINIUM, "run"), (ALUMINIUM, "twin"), (NICKEL, "run"), (NICKEL, "twin")),
    4: ((NICKEL, "run"), (NICKEL, "twin")),
    5: ((ALUMINIUM, "run"), (ALUMINIUM, "twin")),
    6: ((NICKEL, "run"), (NICKEL, "twin")),
    7: ((NICKEL, "run"), (NICKEL, "blunt")),
}


class PaperRuns:
    """The runs of some figures, in a folder."""

    def __init__(
        self,
        folder: Path,
        size: PaperSize,
        *,
        threads: int | None,
        progress: Callable[[], Any],
        note: Callable[[str], None],
    ) -> None:
        self.folder, self.size = folder / RUNS, size
        self._threads, self._progress, self._note = threads, progress, note
        self._loaded: dict[PaperRun, Run] = {}

    def missing(self, figures: Sequence[int]) -> dict[PaperRun, float]:
        """Runs of some figures that are not complete yet, with the estimated time of one thread [min]."""
        needed = dict.fromkeys(PaperRun(*run) for figure in figures for run in _NEEDED.get(figure, ()))
        return {run: self._minutes(run) for run in needed if self._kept(run) is None}

    def _minutes(self, run):
        path = self._write_settings(run)
        return 60 * (estimate_cost(read_config(path), 1).hours or 0.0)

    def _write_settings(self, run):
        self.folder.mkdir(parents=True, exist_ok=True)
        path = (self.folder / run.file(self.size)).with_suffix(".toml")
        text = run.settings(self.size).encode()
        if not path.exists() or path.read_bytes() != text:
            with replace_file(path) as file:
                file.write(text)
        return path

    def _kept(self, run):
        """A complete run, or None."""
        path = self.folder / run.file(self.size)
        if run not in self._loaded and path.exists() and is_run(path):
            kept, config = load(path), read_config(self._write_settings(run))
            if len(kept) == config.n_ions and kept.provenance.get("settings") == config.key:
                self._loaded[run] = kept
        return self._loaded.get(run)

    def get(self, case: PaperCase, role: str) -> Run:
        """One of the runs, which is simulated if it is not there."""
        run = PaperRun(case, role)
        if (kept := self._kept(run)) is not None:
            return kept
        path = self.folder / run.file(self.size)
        self._note(f"simulating {path.name}")
        settings = self._write_settings(run)
        with advice_as_notes(self._note):
            done = simulate(settings, path, threads=self._threads, resume=True, progress=self._progress())
        if done.interrupted:
            raise KeyboardInterrupt
        self._loaded[run] = done.run
        return done.run
