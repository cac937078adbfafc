"""Result of a fit of emission energies: similarities, the best energies, their errors."""

import json
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np

from apt_evap._common.codec import for_json, to_plain
from apt_evap._common.digits import rounded_text
from apt_evap._common.files import replace_file
from apt_evap._common.notebook import as_table
from apt_evap._common.types import AnyPath, Floats
from apt_evap._common.version import __version__
from apt_evap.detection.detector_map import DetectorMap
from apt_evap.detection.projection import Projection
from apt_evap.emission.perturbations import described
from apt_evap.fit.confirmation import confirmed
from apt_evap.fit.fit_settings import FitSettings
from apt_evap.fit.grid import EnergyGrid
from apt_evap.fit.structure import RegisteredProjection, StructureScores
from apt_evap.maps.crystallography.orientation import Orientation
from apt_evap.maps.registration.register import Registration
from apt_evap.maps.registration.verdict import Likeness, likeness, symmetric_places

LEAST_CEILING = 0.1
"""Score of two halves of the measured ions below which scores are not corrected for noise: it would be a division of
noise by noise."""
RULE_OF_METAL = "rule of the metal"
"""Baseline of `RollUp.of_metal`, for which nothing is fitted to the map."""
PREDICTED = "roll-up predicted for the metal"
"""The same in texts."""
ABOVE_NOISE = 2.0
"""Standard deviations above 0 of an uncorrected score that is corrected for noise."""


class Score(NamedTuple):
    """A similarity and its standard deviation over the resamples (NaN without resamples)."""

    value: float
    """Similarity of all ions."""
    error: float
    """Standard deviation over the resamples."""

    @classmethod
    def of_resamples(cls, similarities: Floats) -> "Score":
        """Return the first similarity, for all ions, with the standard deviation of the others, for resamples."""
        error = similarities[1:].std(ddof=1) if len(similarities) > 2 else np.nan
        return cls(float(similarities[0]), float(error))

    def __str__(self):
        return f"{self.value:z.3f}" + (f" ± {self.error:.3f}" if np.isfinite(self.error) else "")


@dataclass(frozen=True)
class Optimum:
    """Energies with the largest similarity of simulated and measured map.

    Parameters
    ----------
    perturbation : perturbation
        Perturbation of the ions.
    mean : float
        Mean of the energy before the truncation [eV].
    relative_spread : float
        Standard deviation before the truncation, relative to the mean.
    rollup_fraction : float
        Fraction of the energy for the roll-up.
    true_mean, true_standard_deviation : float
        Mean and standard deviation after the truncation [eV].
    score : Score
        Similarity with the measured map.
    intervals : dict
        Bounds of 95 %, for each of these five numbers and for each option by name. They contain the noise of the ions
        and the error of the model, and follow the ridge of equal true means (``fit/intervals.py``). Empty without
        resamples.
    at_edge : tuple of str
        "mean", "relative_spread" and options that are at an end of the grid: the best value may then be beyond it.
    options : dict
        Options of the perturbation that are axes of the grid, by name.
    open_ends : dict
        Whether the lower and the upper bound of an interval are at an end of the grid, two bools by name: the interval
        may then continue beyond it.
    """

    perturbation: object
    mean: float
    relative_spread: float
    rollup_fraction: float
    true_mean: float
    true_standard_deviation: float
    score: Score
    intervals: dict
    at_edge: tuple
    options: dict = field(default_factory=dict)
    open_ends: dict = field(default_factory=dict)

    def bounded(self, name: str) -> str:
        """Text of one of the numbers and its interval, str."""
        return self.scaled(name, 1.0)

    def scaled(self, name: str, factor: float) -> str:
        """Text of one of the numbers and its interval, times a factor, str."""
        value = self.options[name] if name in self.options else getattr(self, name)
        return bounded_text(value, self.intervals.get(name), self.open_ends.get(name), factor)


@dataclass(frozen=True, eq=False, repr=False)
class Study:
    """Scores of simulated maps against a measured one for a grid of energies; result of `fit_energies`.

    Matrices have the shape (options, rollup fractions, relative standard deviations, means); without options the last
    three.

    Parameters
    ----------
    grid : EnergyGrid
        Mechanism and energies.
    scores, errors : ndarray
        Concordance of folded maps, or structural similarity (`FitSettings.objective`), at every point of the grid
        (noise-corrected unless switched off in `settings`), and its standard deviation over the resamples. With the
        correction the similarity is about 1 for the true energies: 0.97 to 1.06 in twin experiments, and larger if both
        maps have common noise, such as two maps of one run.
    shares : ndarray
        Fraction of the resamples in which a point is the best.
    resampled : ndarray
        Scores in every resample, shape (resamples, ...).
    optimum, refined : Optimum
        The best point of the grid, and the maximum of a spline around it.
    baselines : dict of Score
        Scores of the "unperturbed" and "thermal" maps. For a pure metal at a constant potential also of the "rule of
        the metal", `RollUp.of_metal`: nothing in it is fitted to the map.
    plain : dict of Score
        Uncorrected scores of the baselines and of the "optimum", for comparison with the ceiling.
    gain : Score
        Score of the optimum minus that of the unperturbed map, for paired resamples.
    gain_share : float
        Fraction of the resamples in which the optimum is better than the unperturbed map.
    ceiling : Score or None
        Uncorrected score of two random halves of the measured ions; None for a map of densities.
    registration : Registration
        Transform of simulated hits into the measured frame.
    measured : DetectorMap
        The measured map; its mask is the compared region.
    maps : dict of DetectorMap
        Simulated maps in the measured frame: those of the baselines, and "optimum".
    structure : StructureScores or None
        Rings about the pole: contrast of the zone lines, radial densities, and folded maps. None if no pole with its
        rings is inside the compared region; ``provenance["structure"]`` contains the reason.
    settings : FitSettings
        Settings of the comparison, the random draws and the resampling.
    provenance : dict
        All other input of the study, in plain types: run, measured map, bins, rounds of the registration.
    """

    grid: EnergyGrid
    scores: np.ndarray
    errors: np.ndarray
    shares: np.ndarray
    resampled: np.ndarray
    optimum: Optimum
    refined: Optimum
    baselines: dict
    plain: dict
    gain: Score
    gain_share: float
    ceiling: Score | None
    registration: Registration
    measured: DetectorMap
    maps: dict
    structure: StructureScores | None
    settings: FitSettings
    provenance: dict

    @cached_property
    def likeness(self) -> Likeness:
        """Whether the best simulated map and the measured one show the same crystal along the same axis.

        The symmetries about a pole must agree, the folded maps correlate, and the lines have the same sign.
        """
        places = symmetric_places(self.orientation, self._projection)
        by_symmetry = likeness(self.maps["optimum"], self.measured, self.registration, about=places)
        scores = self.structure
        pair = (None, None) if scores is None else (scores.optimum, scores.measured)
        return confirmed(by_symmetry, *pair)

    @property
    def no_energy(self) -> str:
        """Reason why the study gives no energy, as part of a sentence; empty if it gives one."""
        if self.likeness.verdict != "alike":
            return _VERDICTS[self.likeness.verdict]
        if self.registration.doubtful:
            return "the registration is doubtful"
        if "true_mean" not in self.refined.intervals:
            return "the errors are not known without resamples"
        below, above = self.refined.open_ends.get("true_mean", (False, False))
        if below or above:
            sides = "neither a lower nor an upper" if below and above else "no lower" if below else "no upper"
            return f"the interval of 95 % has {sides} bound within the grid"
        return ""

    @property
    def no_score(self) -> str:
        """Reason why the study gives no score that is corrected for noise; empty if it gives one."""
        if self.likeness.verdict != "alike":
            return _VERDICTS[self.likeness.verdict]
        plain = self.plain["optimum"]
        if plain.value <= ABOVE_NOISE * np.nan_to_num(plain.error):
            return "the uncorrected one is not above its noise"
        if self.ceiling is None:
            return "the noise of the measured densities is not known"
        if self.ceiling.value < LEAST_CEILING:
            return f"two halves of the measured ions reach only {self.ceiling}"
        return ""

    @property
    def score_text(self) -> str:
        """The score of the best map as text, with its ceiling; uncorrected for noise if a correction means nothing.

        Scores of maps that are not alike are not comparable with those of maps that are, and not given.
        """
        if self.likeness.verdict != "alike":
            return f"no {self.settings.score_name}: {self.no_score}"
        corrected = self.settings.allow_noise and not self.no_score
        best = self.optimum.score if corrected else self.plain["optimum"]
        unperturbed = self.baselines["unperturbed"] if corrected else self.plain["unperturbed"]
        text = f"{self.settings.score_name} {best}, unperturbed {unperturbed}"
        if RULE_OF_METAL in self.baselines:
            rule = (self.baselines if corrected else self.plain)[RULE_OF_METAL]
            text += f", {PREDICTED} (not fitted) {rule}"
        if corrected:
            text += f"; uncorrected for noise {self.plain['optimum']}"
        elif self.settings.allow_noise:
            text += f"; not corrected for noise: {self.no_score}"
        return text + (f", two halves of the measured ions {self.ceiling}" if self.ceiling else ", ceiling not known")

    @property
    def _projection(self):
        stored = self.provenance.get("projection")
        return None if stored is None else Projection(stored["scale"], compression=stored["compression"])

    @property
    def orientation(self) -> Orientation | None:
        """Orientation of the simulated crystal; None for a specimen made from positions."""
        return Orientation.known(self.provenance["run"]["tip"])

    @property
    def projection(self) -> RegisteredProjection | None:
        """Projection from directions in the simulated specimen onto the measured map; None with too few ions."""
        projection = self._projection
        return None if projection is None else RegisteredProjection(projection, self.registration)

    def compared(self, map: DetectorMap) -> DetectorMap:
        """Prepare a map of the measured frame as for the comparison: common region, flattened and smoothed."""
        flat = replace(map, mask=self.measured.mask).flattened(self.settings.flattening or 0.0)
        return flat.smoothed(self.settings.smoothing or 0.0)

    def to_dict(self) -> dict[str, Any]:
        """Return results and settings in plain types, NaN as None, dict."""
        names = ("scores", "errors", "shares", "gain_share", "optimum", "refined", "registration", "gain", "ceiling")
        names += ("baselines", "plain", "real_energies", "likeness", "no_energy", "no_score", "energy", "result")
        results = to_plain({name: getattr(self, name) for name in names})
        results["made_by"] = f"apt_evap {__version__}"
        results["grid"] = to_plain(self.grid) | {"mechanism": self.grid.name}
        for name in ("optimum", "refined"):
            results[name]["perturbation"] = described(getattr(self, name).perturbation)
        results["registration"]["doubtful"] = bool(self.registration.doubtful)
        scores = self.structure
        results["structure"] = scores and scores.to_dict()
        return for_json(results | {"settings": to_plain(self.settings) | self.provenance})

    def save(self, path: AnyPath) -> None:
        """Write results and settings to a JSON file; the file is replaced only when complete.

        Parameters
        ----------
        path : str or path-like
            File to write or replace.

        Raises
        ------
        FileError
            If the file cannot be written.
        """
        with replace_file(path) as file:
            file.write((json.dumps(self.to_dict(), indent=1, allow_nan=False) + "\n").encode())

    @property
    def best_cell(self) -> tuple[int, ...]:
        """Index of the best point of the grid."""
        best = self.optimum
        values = {
            **best.options,
            "rollup_fraction": best.rollup_fraction,
            "relative_spread": best.relative_spread,
            "mean": best.mean,
        }
        return tuple(axis.index(values[name]) for name, axis in self.grid.axes.items())

    def __repr__(self) -> str:
        if self.likeness.verdict != "alike":
            return f"<Study: maps {self.likeness.verdict}, no energy and no score>"
        return f"<Study: maps alike; {self.result}; {self.score_text}>"

    _repr_html_ = as_table

    def lines(self) -> list[str]:
        """Result, score, and doubts if there are any: at most three lines, list of str."""
        best = self.optimum
        first = f"{_VERDICTS[self.likeness.verdict]} ({self.likeness.reason})"
        if self.likeness.verdict == "alike":
            results = [f"{first}{', but' if self.no_energy else ';'} {self.result}", self.score_text]
        else:
            results = [f"{first}; so no energy and no score are given"]
        doubts = []
        if self.registration.doubtful:
            doubts.append(f"the registration, correlation {self.registration.score:.2f}")
        if best.at_edge and self.likeness.verdict == "alike":
            doubts.append(f"best at the end of the grid in {' and '.join(best.at_edge)}")
        if self.structure is not None and self.structure.lost:
            doubts.append("the best map has lost the zone lines")
        elif self.structure is not None and self.structure.disagrees and not self.no_energy:
            doubts.append(f"the rings about the pole are best at {self.point(self.structure.best)}")
        return [*results, *([f"doubt: {'; '.join(doubts)}"] if doubts else [])]

    @property
    def real_factor(self) -> tuple[float, str]:
        """Factor from energies of the fit to those of the experiment, and what they are energies at.

        1 and the simulated voltage, if the operating point of the run is not known.
        """
        real = self.provenance.get("real_units")
        if real is None:
            return 1.0, f"at the simulated voltage, {self.provenance['run']['voltage']:g} V"
        return real["real_per_study"], f"at {real['operating_field']:.3g} V/nm and {real['flight_charge']}+"

    @property
    def energy(self) -> str:
        """Mean energy after the truncation at the field of the experiment [eV], with its interval; empty if none."""
        return "" if self.no_energy else self.refined.scaled("true_mean", self.real_factor[0])

    @property
    def result(self) -> str:
        """The result as one sentence: how the ions leave, and their mean energy or the reason why it is not given.

        The mean is that after the truncation, at the field of the experiment if it is known.
        """
        refined, (_, where) = self.refined, self.real_factor
        if self.no_energy:
            return f"no energy is given: {self.no_energy}"
        material = self.provenance["run"]["tip"].get("material")
        name = material.get("name") if isinstance(material, dict) else material
        ions = f"{name} ions" if isinstance(name, str) else "ions"
        energy = f"a mean of {self.energy} eV {where}"
        mechanism = self.grid.mechanism
        if mechanism == "roll-up":
            text = f"{ions} roll up with {energy}"
        elif mechanism == "lateral":
            text = f"{ions} leave with lateral energies with {energy}"
        elif mechanism == "combined":
            text = f"{ions} roll up in part, a fraction of {refined.bounded('rollup_fraction')}, with {energy}"
        else:
            text = f"{ions} leave by {self.grid.name} with {energy}"
        varied = [name for name in refined.options if len(self.grid.options[name]) > 1]
        return text + "".join(f", {name} {refined.bounded(name)}" for name in varied)

    def point(self, index: tuple[int, ...]) -> str:
        """Text of the energies and options at an index of the grid, str."""
        values = dict(zip(self.grid.axes, self.grid.values_at(np.asarray(index)).tolist(), strict=True))
        fraction = values.pop("rollup_fraction")
        text = f"{values.pop('mean'):g} eV, sigma/mean {values.pop('relative_spread'):.3g}"
        text += f", roll-up fraction {fraction:g}" if self.grid.mechanism == "combined" else ""
        return text + "".join(f", {name} {value:g}" for name, value in values.items())

    @property
    def real_energies(self) -> tuple[float, float] | None:
        """Mean and standard deviation of the refined optimum in real units [eV]; None if these are not known.

        Real units are those of `Run.at_evaporation_field`: of the run if it was converted, otherwise with its defaults.
        """
        real = self.provenance.get("real_units")
        if real is None:
            return None
        factor = real["real_per_study"]
        return self.refined.true_mean * factor, self.refined.true_standard_deviation * factor


_VERDICTS = {
    "alike": "the maps are alike",
    "doubtful": "it is doubtful that the maps are alike",
    "not alike": "the maps are not alike",
}


def bounded_text(
    value: float,
    interval: Sequence[float] | None,
    open_ends: Sequence[bool] | None = None,
    factor: float = 1.0,
) -> str:
    """Text of a number and its interval with the digits that it allows; open ends are "at most" and "at least"."""
    if interval is None or interval[0] == interval[1]:  # not known, or given
        return f"{value * factor:.3g}"
    low, high = (bound * factor for bound in interval)
    number, first, last = (rounded_text(part, abs(high - low) / 2) for part in (value * factor, low, high))
    below, above = open_ends or (False, False)
    return f"{number} ({'at most ' * below}{first} to {'at least ' * above}{last})"
