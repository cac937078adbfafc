"""Figures 2 to 7 of Shaikh et al. (2025), with captions that say what agrees: of twins, or of a measured map."""

from __future__ import annotations

import json
import os
import shutil
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from scipy.spatial import cKDTree

from apt_evap import plot
from apt_evap._common.codec import for_json, to_plain
from apt_evap._common.files import FileError, check_path, replace_file
from apt_evap._common.kept import check_made_from
from apt_evap._common.types import AnyPath, Floats, Integers
from apt_evap.detection.detector import Detector
from apt_evap.detection.detector_map import DetectorMap
from apt_evap.detection.hits import Hits
from apt_evap.fit.fit_energies import fit_energies
from apt_evap.fit.fit_settings import FitSettings
from apt_evap.fit.grid import EnergyGrid
from apt_evap.fit.study import Study
from apt_evap.maps.profiles import Rectangle, compare_profiles, zone_line_profile
from apt_evap.maps.registration.register import Registration
from apt_evap.maps.zone_line import fit_zone_line
from apt_evap.plot._figure import new_figure
from apt_evap.plot.profile_figures import rectangles as draw_rectangles
from apt_evap.plot.report.html_page import Page, heading, paragraph
from apt_evap.plot.responses import ion_colors
from apt_evap.plot.specimen_figures import mark_atoms
from apt_evap.simulation.response_tracks import lateral_tracks, rollup_tracks
from apt_evap.simulation.run import Run
from apt_evap.simulation.simulation import Simulation
from apt_evap.specimen.materials import Material, as_material
from apt_evap.specimen.tip import Tip
from apt_evap.workflows.measured_source import MeasuredSource, source_of
from apt_evap.workflows.paper_runs import ALUMINIUM, FULL, NICKEL, QUICK, PaperCase, PaperRuns
from apt_evap.workflows.simulate_file import no_note
from apt_evap.workflows.twin_of_map import Twin, twin

FIGURES = (2, 3, 4, 5, 6, 7)
"""Figures that can be made; figure 1 of the paper is a drawing."""
OF_A_MAP = (3, 4, 5, 6)
"""Figures that a measured map can take the place of a twin in."""
RECORD, PAGE, TWIN = "paper.json", "figures.html", "twin"
AGREES, DIFFERS, OPEN = "agrees", "does not agree", "cannot be shown"

_ENERGIES = np.linspace(0, 1, 51)  # [eV], of figure 2
# numbers of nearest neighbours: 6 at a kink, 7 at a step, 8 in a row along a step; and directions from the cap centre
_NEIGHBOURS = (6, 6, 7, 7, 8, 6)
_DIRECTIONS = ((8, 200), (33, 75), (22, 320), (36, 190), (30, 260), (28, 20))  # polar angle and azimuth [degrees]
_STRAIGHT = 0.1  # of the length of a track: the largest distance from a straight line
_ROUND = 0.5  # smallest over largest displacement of all directions
# of the twins on their detector, and its field of view: 31 degrees of flight directions
_INSTRUMENT = Registration(rotation=8.0, scale=0.3, shift=(1.5, -1.0))
_FIELD_OF_VIEW = 18.0  # [mm], radius
_LINES = {  # of nickel [111]; there are three of each kind
    "depleted": Rectangle(centre=(52, 0), angle=180, length=36, width=24),
    "enhanced": Rectangle(centre=(0, -28), angle=-90, length=24, width=30),
}
_TURNS = (0, 120, 240)  # [degrees]
_PROFILE_BINS = 30
_CHANCE, _CERTAIN = 2.0, 3.0  # errors: a difference that may be chance, and one that is not
_TWINS = (
    "The experiments of the paper are not public. The measured map is that of a twin: another specimen, with other "
    "random numbers and the energies of the paper. So the figure shows that the method finds hidden energies, not that "
    "the metals have them: the public maps of nickel do not confirm 0.155 eV. A similarity above 1 says that its "
    "correction for noise is not exact."
)
_OWN = (
    "The energies are those at the field of the simulated specimen. They depend on its radius, on the rule of the "
    "roll-up, and on everything else that blurs a map."
)


@dataclass(frozen=True)
class PaperClaim:
    """A claim of the paper beside what is here.

    Parameters
    ----------
    claim : str
        What the paper says.
    verdict : str
        `AGREES`, `DIFFERS` or `OPEN`.
    here : str
        The numbers.
    """

    claim: str
    verdict: str
    here: str

    def __str__(self) -> str:
        return f"{self.verdict[0].upper()}{self.verdict[1:]}: {self.claim} Here: {self.here}"


def _judged(claim, holds, here, study=None):
    """A claim with its verdict; a study of a measured map judges only if the maps are alike."""
    if study is not None and study.likeness.verdict != "alike":
        return PaperClaim(claim, OPEN, f"{here} {'; '.join(study.lines())}.")
    return PaperClaim(claim, AGREES if holds else DIFFERS, here)


@dataclass(frozen=True)
class PaperFigure:
    """One of the figures.

    Parameters
    ----------
    number : int
        As in the paper.
    title : str
        What it shows.
    claims : tuple of PaperClaim
        Claims of the paper, compared.
    limits : str
        What it cannot show.
    numbers : dict
        All numbers, in plain types.
    """

    number: int
    title: str
    claims: tuple[PaperClaim, ...]
    limits: str
    numbers: Mapping[str, Any]

    @property
    def caption(self) -> str:
        """Paragraphs: title, claims, limits."""
        parts = [f"Figure {self.number}. {self.title}", *map(str, self.claims), self.limits]
        return "\n\n".join(part for part in parts if part) + "\n"


# ---- figure 2: chosen atoms ------------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class _ChosenFirst:
    """Law by which chosen atoms evaporate before all others."""

    atoms: Integers

    def keys(self, tip: Tip, atoms: Integers, fields: Floats, bonds: Integers) -> Floats:
        """Ratios of field to evaporation field, multiplied by a million for the chosen atoms."""
        ratios = fields / tip.evaporation_fields[tip.species[atoms]]
        return np.where(tip.evaporable[atoms], ratios, 0.0) * np.where(np.isin(atoms, self.atoms), 1e6, 1.0)


def _chosen(emitter):
    """Indices of surface atoms with the numbers of neighbours, closest to the directions."""
    tip, positions = emitter.tip, emitter.positions
    neighbours = cKDTree(tip.positions).query_ball_point(positions, tip.bond_length, return_length=True) - 1
    directions = positions / np.linalg.norm(positions, axis=1)[:, None]
    choice = []
    for number, (polar, azimuth) in zip(_NEIGHBOURS, np.radians(_DIRECTIONS), strict=True):
        direction = [np.sin(polar) * np.cos(azimuth), np.sin(polar) * np.sin(azimuth), np.cos(polar)]
        choice.append(np.argmax(np.where(neighbours == number, directions @ direction, -1.0)))
    return emitter.atoms[choice]


def _response(case, radius, threads):
    """Emitter before the run, run in which only the chosen atoms evaporate, its ions in order of choice."""
    metal = as_material(case.element)
    tip = Tip(metal, radius * metal.a, case.axis, shank_length=radius * metal.a, depth=8 * metal.a)
    emitter = Simulation(tip, n_threads=threads).emitter
    atoms = _chosen(emitter)
    simulation = Simulation(tip, seed=1, law=_ChosenFirst(atoms), n_threads=threads)
    run = simulation.run(len(atoms), progress=False).unless_interrupted()
    return emitter, run, [int(np.flatnonzero(run.site == atom)[0]) for atom in atoms]


def _reach(x, y, start):
    """Distances of the hits of each ion from its start [mm], (n, -1)."""
    n = len(x)
    return np.hypot(x.reshape(n, -1) - start.x.reshape(n, 1), y.reshape(n, -1) - start.y.reshape(n, 1))


def _bend(tracks):
    """Largest distance of the places of each track from the line through its ends, over its length, (n,)."""
    places = np.stack([tracks.x, tracks.y], axis=-1).reshape(len(tracks.x), -1, 2)
    ends = places[:, -1] - places[:, 0]
    steps = places - places[:, :1]
    aside = np.abs(steps[..., 0] * ends[:, None, 1] - steps[..., 1] * ends[:, None, 0])
    return aside.max(axis=1) / (ends**2).sum(axis=1)


def _range(values, unit=""):
    return f"{np.min(values):.2g} to {np.max(values):.2g}{unit}"


def _figure_2(radius: int, threads: int | None) -> tuple[Figure, PaperFigure]:
    """Hits of six atoms of each metal for energies from 0 to 1 eV."""
    figure = new_figure((10.4, 9.4))
    numbers: dict[str, Any] = {"radius [a]": radius}
    moved: dict[str, dict[str, Floats]] = {}
    for (apex_view, detector), case in zip(figure.subplots(2, 2), (ALUMINIUM, NICKEL), strict=True):
        emitter, run, ions = _response(case, radius, threads)
        mechanism = "lateral velocity" if case.mechanism == "lateral" else "roll-up"
        plot.specimen(emitter, ax=apex_view, colormap="bone", title=f"{case.name}, R = {radius:g} a")
        mark_atoms(run.emissions.positions[ions], apex_view, colors=ion_colors(len(ions)))
        title = f"{case.name}, {mechanism}"
        plot.response(run, ions, mechanism, detector, energies=_ENERGIES, zoom=1, title=title)
        start = lateral_tracks(run, ions, [0.0], [0.0])
        lateral, (roll, after) = lateral_tracks(run, ions, [0.5]), (rollup_tracks(run, ions, [e]) for e in (0.0, 0.5))
        reach = _reach(lateral.x, lateral.y, start)
        moved[case.element] = {
            "lateral": reach.max(axis=1),
            "roundness": reach.min(axis=1) / reach.max(axis=1),
            "jump": _reach(roll.x, roll.y, start).max(axis=1),
            "after": _reach(after.x, after.y, roll).max(axis=1),
            "bend": _bend(rollup_tracks(run, ions, _ENERGIES)),
        }
        numbers[case.name] = {
            "neighbours": list(_NEIGHBOURS),
            "field [V/nm]": run.fields[ions].tolist(),
            "lateral 0.5 eV [mm]": moved[case.element]["lateral"].tolist(),
            "least over largest of all directions": moved[case.element]["roundness"].tolist(),
            "roll [mm]": moved[case.element]["jump"].tolist(),
            "then 0.5 eV [mm]": moved[case.element]["after"].tolist(),
            "distance from a straight track over its length": moved[case.element]["bend"].tolist(),
            "residual [mm]": run.responses.residuals[ions].max(axis=1).tolist(),  # type: ignore[union-attr]
        }
    al, ni = moved["Al"], moved["Ni"]
    ratio = ni["jump"] / ni["lateral"]
    claims = (
        _judged(
            "lateral velocities spread the hits of an atom in all directions.",
            al["roundness"].min() > _ROUND,
            f"0.5 eV moves hits of aluminium by {_range(al['lateral'], ' mm')}, in the least direction by "
            f"{_range(al['roundness'])} of that in the largest.",
        ),
        _judged(
            "roll-up moves hits along straight tracks, after a jump without energy.",
            ni["bend"].max() < _STRAIGHT,
            f"tracks of nickel are straight within {ni['bend'].max():.1%} of their length; the jumps are "
            f"{_range(ni['jump'], ' mm')}.",
        ),
        _judged(
            "the jump of nickel is as large as the effect of about 0.5 eV.",
            ratio.min() < 1 < ratio.max(),
            f"it is {_range(ratio)} of it. Distances grow with the root of the energy, so it is that of "
            f"{_range(0.5 * ratio**2, ' eV')}.",
        ),
    )
    title = "Hits of six atoms each of Al[012] and Ni[111] for energies from 0 to 1 eV. Atoms and hits have one colour."
    limits = "One specimen each; the atoms are at kinks, at steps and in rows along steps, not those of the paper."
    if radius != FULL.radius:  # 0.7 to 1.4 of the effect of 0.5 eV at 20 a, 0.2 to 0.7 at 80 a
        limits += f" The jump shrinks with the radius: R = {radius} a, the paper has {FULL.radius} a (--full)."
    return figure, PaperFigure(2, title, claims, limits, numbers)


# ---- figures 3 to 6: energies ----------------------------------------------------------------------------------------


@dataclass
class _Fitted:
    """Studies of one metal or map by mechanism, made when they are needed."""

    name: str
    run: Run
    measured: Hits | DetectorMap
    settings: FitSettings
    threads: int | None
    progress: Any
    registration: Registration | None = None

    def __post_init__(self) -> None:
        self._studies: dict[str, Study] = {}

    def study(self, mechanism: str) -> Study:
        """Scores on the grid of the paper; all mechanisms have one registration, so that they can be compared."""
        if mechanism not in self._studies:
            study = self._studies[mechanism] = fit_energies(
                self.run,
                self.measured,
                EnergyGrid(mechanism),
                self.settings,
                registration=self.registration,
                n_threads=self.threads,
                progress=False if self.progress is False else None,
            )
            self.registration = study.registration
        return self._studies[mechanism]


def _point(study):
    best = study.optimum
    fraction = f", roll-up fraction {best.rollup_fraction:g}" if study.grid.mechanism == "combined" else ""
    return f"{best.mean:g} eV, σ/mean {best.relative_spread:g}{fraction}"


def _clear_maximum(study, name, is_twin):
    """Whether the best score is above the median of the grid by more than chance."""
    best, middle = study.optimum.score, float(np.median(study.scores))
    holds = best.value - middle > _CERTAIN * np.nan_to_num(best.error)
    text = f"{name}, {study.grid.name}: best {best.value:.2f} ± {best.error:.2f}, median of the grid {middle:.2f}."
    claim = "the similarity has a clear maximum over mean and width of the energy."
    return _judged(claim, bool(holds), text, None if is_twin else study)


def _is_at(study, case, fraction=None):
    """Whether the best point of the grid is that of the paper."""
    best = study.optimum
    same = (best.mean, best.relative_spread) == (case.mean, case.relative_spread)
    return same and (fraction is None or best.rollup_fraction == fraction)


def _recovered(case, study, fraction=None):
    """What a twin says about the optimum of the paper."""
    hidden = f"{case.mean:g} eV, σ/mean {case.relative_spread:g}" + (f", fraction {fraction:g}" if fraction else "")
    found = "found again" if _is_at(study, case, fraction) else f"not found on the grid: best is {_point(study)}"
    true_mean = study.refined.bounded("true_mean")
    text = f"hidden in the twin: {hidden}; {found}; mean after truncation {true_mean} eV"
    true = case.perturbation.energy.true_mean  # type: ignore[attr-defined]
    return f"{text}, hidden {true:.3f} eV."


def _figure_3(fits: Sequence[tuple[_Fitted, str]], case_of: Mapping[str, PaperCase], is_twin: bool):
    """Scores over mean and width for two mechanisms."""
    figure = new_figure((12.0, 5.0))
    claims = []
    studies = [(fitted, mechanism, fitted.study(mechanism)) for fitted, mechanism in fits]
    for ax, (fitted, mechanism, study) in zip(figure.subplots(1, 2), studies, strict=True):
        plot.score_matrix(study, [ax])
        ax.set_title(f"{fitted.name}, {mechanism}")
        claims.append(_clear_maximum(study, fitted.name, is_twin))
        if case := case_of.get(mechanism):
            claim = f"the optimum of {case.element} is {case.mean:g} eV, σ/mean {case.relative_spread:g}."
            if is_twin:
                claims.append(PaperClaim(claim, OPEN, _recovered(case, study)))
            else:
                claims.append(_judged(claim, _is_at(study, case), f"{_point(study)}.", study))
    if is_twin:
        al, ni = (study.plain["optimum"] for _, _, study in studies)
        text = f"uncorrected for noise {al.value:.2f} and {ni.value:.2f}, but both maps are simulated by one program."
        claims.append(PaperClaim("the similarity of nickel is lower than that of aluminium.", OPEN, text))
    title = "Similarity with the measured map over mean and width of the energy."
    numbers = {f"{fitted.name}, {mechanism}": study.to_dict() for fitted, mechanism, study in studies}
    return figure, PaperFigure(3, title, tuple(claims), _TWINS if is_twin else _OWN, numbers)


def _figure_4(fitted: _Fitted, is_twin: bool, is_nickel: bool):
    """Scores of combined emission for five fractions of the energy that go into the roll-up."""
    study = fitted.study("combined")
    best = study.optimum
    claims = [_clear_maximum(study, fitted.name, is_twin)]
    claim = "with 25 % of the energy of nickel in random directions the similarity is a little higher."
    if is_twin:
        claims.append(PaperClaim(claim, OPEN, _recovered(NICKEL, study, fraction=1.0)))
    elif is_nickel:
        claims.append(_judged(claim, best.rollup_fraction == 0.75, f"{_point(study)}.", study))
    figure = plot.score_matrix(study)[0].figure
    title = f"{fitted.name}: similarity for five fractions of the energy that go into the roll-up."
    return figure, PaperFigure(4, title, tuple(claims), _TWINS if is_twin else _OWN, {"combined": study.to_dict()})


def _figure_of_maps(number: int, fitted: _Fitted, case: PaperCase | None, mechanism: str):
    """Measured, unperturbed and best map, and an enlarged part."""
    study = fitted.study(mechanism)
    best, unperturbed = study.optimum, study.baselines["unperturbed"]
    first = "measured" if case is None else f"twin, {case.mean:g} eV, σ/mean {case.relative_spread:g}"
    titles = (
        first,
        "simulated, unperturbed",
        f"simulated, {mechanism}\n{best.mean:g} eV, σ/mean {best.relative_spread:g}",
    )
    figure = plot.side_by_side(study, titles=titles)[0].figure
    gain = study.gain
    closer = gain.value > _CERTAIN * np.nan_to_num(gain.error)
    scores = (
        f"{fitted.name}: unperturbed {unperturbed.value:.2f}, with {mechanism} {best.score.value:.2f}, gain {gain}."
    )
    claims = [
        _judged(
            "with the best energies the map is much closer to the measured one than without.",
            closer,
            scores,
            None if case else study,
        )
    ]
    if mechanism == "roll-up" and (case is not None or fitted.name.startswith("Ni")):
        bare, rolled = (study.compared(study.maps[name]) for name in ("unperturbed", "optimum"))
        inside = bare.mask & rolled.mask
        r = float(np.corrcoef(bare.density[inside], rolled.density[inside])[0, 1])
        text = f"the correlation of the unperturbed and the rolled map is {r:.2f}: " + (
            "lines that are bright after roll-up are bright, too." if r > 0 else "they are dark where it is bright."
        )
        claims.append(_judged("unperturbed maps of nickel show the same bright lines, less prominently.", r > 0, text))
    title = f"{fitted.name}: measured map, and simulated maps without perturbation and with {mechanism}."
    limits = _OWN if case is None else _TWINS
    return figure, PaperFigure(number, title, tuple(claims), limits, {mechanism: study.to_dict()})


# ---- figure 7: lines and the radius ----------------------------------------------------------------------------------


def _figure_7(sharp: Run, blunt: Run, radii: tuple[int, int]):
    """Profiles across a depleted and an enhanced line of nickel for two radii."""
    roll_up = NICKEL.perturbation
    hits = [run.hits(roll_up) for run in (blunt, sharp)]
    names = [f"R = {radius} a" for radius in radii[::-1]]
    figure = new_figure((11.0, 9.4))
    panels = figure.subplots(4, 2, width_ratios=(1, 1.15), height_ratios=(3, 1, 3, 1))
    numbers: dict[str, Any] = {"ions": dict(zip(names, (len(blunt), len(sharp)), strict=True))}
    claims = []
    for row, (kind, rectangle) in enumerate(_LINES.items()):
        rectangles = [rectangle.turned(angle) for angle in _TURNS]
        first, second = (zone_line_profile(part, rectangles, bins=_PROFILE_BINS) for part in hits)
        lines = [fit_zone_line(profile, exponent=None) for profile in (first, second)]
        comparison = compare_profiles(first, second)
        ratio = lines[0].width / lines[1].width
        error = ratio * float(np.hypot(*np.array([line.width_error / line.width for line in lines])))
        numbers[kind] = {
            "lines": {name: asdict(line) for name, line in zip(names, lines, strict=True)},
            "ratio": ratio,
            "ratio_error": error,
            "chi_square": comparison.chi_square,
            "degrees_of_freedom": comparison.degrees_of_freedom,
        }
        widths = " and ".join(f"{line.width:.1f} ± {line.width_error:.1f} mm" for line in lines)
        errors = abs(ratio - 1) / error
        claims.append(
            PaperClaim(
                f"the {kind} line is as wide for the blunt tip as for the sharp one.",
                AGREES if errors < _CHANCE else DIFFERS if errors > _CERTAIN else OPEN,
                f"{widths} at {' and '.join(names)}, ratio {ratio:.2f} ± {error:.2f}; a pattern of fixed size on the "
                f"specimen would give {radii[0] / radii[1]:.2f}.",
            )
        )
        for panel in panels[2 * row : 2 * row + 2, 0]:
            panel.remove()
        map_axes = figure.add_subplot(panels[0, 0].get_gridspec()[2 * row : 2 * row + 2, 0])
        density = hits[0].map(like=Detector(width=150.0).grid(150), position_step=None).smoothed(1.0)
        plot.detector_map(density, map_axes, title=f"{kind} lines, {names[0]}")
        draw_rectangles(rectangles, map_axes)
        axes = panels[2 * row : 2 * row + 2, 1]
        axes[1].sharex(axes[0])
        plot.profile_comparison(first, second, names, axes, lines=lines)
    title = "Ni[111] with roll-up: density across a depleted and an enhanced zone line, for two radii."
    limits = f"One specimen of each radius, {radii[0]} a and {radii[1]} a. The paper has 80 a and 120 a: --full."
    return figure, PaperFigure(7, title, tuple(claims), limits if radii != (80, 120) else "", numbers)


# ---- the command -----------------------------------------------------------------------------------------------------


class Paper:
    """The figures of a folder; made by `paper`."""

    def __init__(self, folder: Path, runs: PaperRuns, *, threads: int | None, progress: Any) -> None:
        self.folder, self._runs = folder, runs
        self._threads, self._progress = threads, progress

    @cached_property
    def _aluminium(self) -> _Fitted:
        return self._of_twin(ALUMINIUM)

    @cached_property
    def _nickel(self) -> _Fitted:
        return self._of_twin(NICKEL)

    def _of_twin(self, case):
        size = self._runs.size
        hits = self._runs.get(case, "twin").hits(case.perturbation)
        # the edge of the field of view is known; an outline determined from few hits would extend beyond it
        centres = (np.arange(size.bins) + 0.5) * 2 / size.bins - 1
        inside = np.hypot(centres, centres[:, None]) < 1 - 2 / size.bins
        extent = (-_FIELD_OF_VIEW, _FIELD_OF_VIEW, -_FIELD_OF_VIEW, _FIELD_OF_VIEW)
        measured = _INSTRUMENT.hits(hits).map(bins=size.bins, extent=extent, position_step=None, mask=inside)
        settings = FitSettings(bins=size.bins, resamples=size.resamples, objective="similarity")
        run = self._runs.get(case, "run")
        return _Fitted(case.name, run, measured, settings, self._threads, self._progress)

    def draw(self, number: int) -> tuple[Figure, PaperFigure]:
        """Draw a figure."""
        size = self._runs.size
        match number:
            case 2:
                return _figure_2(size.radius, self._threads)
            case 3:
                pairs = ((self._aluminium, "lateral"), (self._nickel, "roll-up"))
                return _figure_3(pairs, {"lateral": ALUMINIUM, "roll-up": NICKEL}, is_twin=True)
            case 4:
                self._nickel.study("roll-up")  # its registration determines the compared region of both
                return _figure_4(self._nickel, is_twin=True, is_nickel=True)
            case 5:
                return _figure_of_maps(5, self._aluminium, ALUMINIUM, "lateral")
            case 6:
                return _figure_of_maps(6, self._nickel, NICKEL, "roll-up")
        sharp = self._runs.get(NICKEL, "run")[: size.line_ions]
        return _figure_7(sharp, self._runs.get(NICKEL, "blunt"), (size.radius, size.blunt_radius))


class PaperOfMap:
    """Figures 3 to 6 of a measured map, which takes the place of the twins."""

    def __init__(self, made: Twin, element: str, *, threads: int | None, progress: Any) -> None:
        settings = FitSettings(resamples=QUICK.resamples, objective="similarity")
        registration = made.registration
        name = f"{element}, measured"
        self._fitted = _Fitted(name, made.run, made.measured_map, settings, threads, progress, registration)
        self._element = element

    def draw(self, number: int) -> tuple[Figure, PaperFigure]:
        """Draw a figure."""
        is_nickel = self._element == "Ni"
        cases = {case.mechanism: case for case in (ALUMINIUM, NICKEL) if case.element == self._element}
        match number:
            case 3:
                return _figure_3(((self._fitted, "lateral"), (self._fitted, "roll-up")), cases, is_twin=False)
            case 4:
                return _figure_4(self._fitted, is_twin=False, is_nickel=is_nickel)
            case 5:
                return _figure_of_maps(5, self._fitted, None, "lateral")
        return _figure_of_maps(6, self._fitted, None, "roll-up")


def paper(
    folder: AnyPath = "paper",
    figures: Sequence[int] | None = None,
    *,
    full: bool = False,
    measured: MeasuredSource | Hits | DetectorMap | AnyPath | None = None,
    element: str | Material | None = None,
    twin_options: Mapping[str, Any] | None = None,
    threads: int | None = None,
    progress: Callable[[], Any] = lambda: None,
    note: Callable[[str], None] = no_note,
    command: str = "",
) -> list[PaperFigure]:
    """Make figures 2 to 7 of Shaikh et al. (2025), as ``apt-evap paper`` does.

    The runs are made once and kept in the folder; the same call continues after an interruption, and adds figures.

    Parameters
    ----------
    folder : str or path-like
        Folder for the figures, their captions and the runs.
    figures : sequence of int, optional
        Numbers of the figures, 2 to 7; by default all. Of a measured map 3 to 6.
    full : bool
        Whether the tips are as large as in the paper, R = 80 a and 120 a, instead of 20 a and 30 a.
    measured : MeasuredSource, Hits, DetectorMap, str or path-like, optional
        A measured map, which is indexed, simulated and registered, and takes the place of the twins.
    element : str or Material, optional
        The crystal of the measured map.
    twin_options : mapping, optional
        Options of `twin` for the measured map.
    threads : int, optional
        Number of threads; by default the number of processors that this process may use.
    progress : callable
        Returns the progress of a run, as for `simulate`.
    note : callable
        Receives lines of text on what is done.
    command : str
        Command line to repeat it, for the page.

    Returns
    -------
    list of PaperFigure

    Raises
    ------
    FileError
        If a file cannot be read or written, or the folder has other files.
    ValueError
        If a figure does not exist, or the map has no coordinates or no field of view.
    KeyboardInterrupt
        If it is interrupted; what is done so far is kept.
    """
    known = FIGURES if measured is None else OF_A_MAP
    for number in figures or ():
        if number not in known:
            raise ValueError(f"figure must be one of {', '.join(map(str, known))}, got {number}")
    figures = sorted(set(figures or known))
    folder = check_path(folder)
    if measured is None:
        _check_folder(folder, {"size": "full" if full else "quick"})
        runs = PaperRuns(folder, FULL if full else QUICK, threads=threads, progress=progress, note=note)
        _say_time(runs, figures, note)
        drawing: Any = Paper(folder, runs, threads=threads, progress=progress())
    else:
        if full:
            raise ValueError(
                "full is for the figures of twins: the size of the tip of a measured map follows from minutes"
            )
        source = source_of(measured)
        content = source.read(note)  # before anything is written
        name = as_material(element if element is not None else "").name
        _check_folder(folder, source.made_from() | {"element": name})
        try:
            made = twin(
                replace(source, read=lambda _: content),
                element,  # type: ignore[arg-type]
                folder=folder / TWIN,
                threads=threads,
                progress=progress(),
                note=note,
                command=command,
                **(twin_options or {}),
            )
        except (ValueError, OSError):
            _remove_if_empty(folder)
            raise
        drawing = PaperOfMap(made, name, threads=threads, progress=progress())
    done = []
    for number in figures:
        note(f"figure {number}")
        picture, described = drawing.draw(number)
        _write(folder, picture, described)
        note(f"{described.caption.rstrip()}\n\nwrote {folder / f'figure{number}.png'}")
        done.append(described)
    _write_page(folder, command)
    note(f"wrote {folder / PAGE}")
    return done


def _check_folder(folder, made_from):
    """Make the folder with its record; FileError if it has other files, or was made from something else."""
    record = folder / RECORD
    if os.path.lexists(folder) and not folder.is_dir():
        raise FileError(f"cannot write to {str(folder)!r}: it is not a folder")
    if record.exists():
        try:
            kept = json.loads(record.read_text(encoding="utf-8"))
        except ValueError as error:
            raise FileError(f"{str(record)!r} is not a record of apt-evap paper: {error}") from None
        check_made_from(folder, kept, made_from, "give another folder with -o")
        return
    if folder.is_dir() and any(folder.iterdir()):
        raise FileError(f"{str(folder)!r} is not empty and was not made by apt-evap paper: give another folder with -o")
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise FileError(f"cannot write to {str(folder)!r}: {error.strerror or error}") from error
    with replace_file(record) as file:
        file.write((json.dumps(made_from) + "\n").encode())


def _remove_if_empty(folder):
    """Remove a folder that has nothing but its record."""
    if {path.name for path in folder.iterdir()} <= {RECORD}:
        shutil.rmtree(folder)


def _say_time(runs, figures, note):
    """Say what will be simulated, and how long that takes."""
    missing = runs.missing(figures)
    fits = runs.size.fit_minutes * any(number in OF_A_MAP for number in figures)
    total = sum(missing.values()) + fits
    size = f"{runs.size.name} size, R = {runs.size.radius} a"
    parts = [f"{len(missing)} runs {sum(missing.values()):.0f} min"] if missing else ["all runs are there"]
    parts += [f"fits {fits:.0f} min"] if fits else []
    minutes = max(round(total), 1)
    note(f"{size}: about {minutes} minute{'s' * (minutes > 1)} of one processor ({', '.join(parts)})")


def _write(folder, figure, described):
    name = f"figure{described.number}"
    with replace_file(folder / f"{name}.png") as file:
        figure.savefig(file, format="png", dpi=80)
    with replace_file(folder / f"{name}.txt") as file:
        file.write(described.caption.encode())
    content = for_json(to_plain({"caption": described.caption, "numbers": described.numbers}))
    with replace_file(folder / f"{name}.json") as file:
        file.write((json.dumps(content, indent=1) + "\n").encode())


def _write_page(folder, command):
    """The page of all figures that are in the folder."""
    page = Page("Figures of Shaikh et al. (2025)")
    for number in FIGURES:
        picture, caption = folder / f"figure{number}.png", folder / f"figure{number}.txt"
        if picture.exists() and caption.exists():
            title, *paragraphs = caption.read_text(encoding="utf-8").split("\n\n")
            page.add(heading(title), page.image(picture.read_bytes(), alt=title), *map(paragraph, paragraphs))
    if command:
        page.add(paragraph(f"Made with: {command}", "note"))
    page.save(folder / PAGE)
