"""Result of a fit of emission energies: similarities, the best energies, their errors."""

import json
from dataclasses import asdict, dataclass, replace
from typing import Any, NamedTuple

import numpy as np

from apt_evap._common.files import replace_file
from apt_evap._common.types import AnyPath, Floats
from apt_evap._version import __version__
from apt_evap.detection.detector_map import DetectorMap
from apt_evap.emission.perturbations import to_dict
from apt_evap.energy_fit.grid import EnergyGrid
from apt_evap.energy_fit.settings import StudySettings
from apt_evap.registration.register import Registration


class Score(NamedTuple):
    """A similarity and its standard deviation over the resamples (NaN without resamples)."""

    value: float
    error: float

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
    rsd : float
        Standard deviation before the truncation, relative to the mean.
    rollup_fraction : float
        Fraction of the energy for the roll-up.
    true_mean, true_standard_deviation : float
        Mean and standard deviation after the truncation [eV].
    score : Score
        Similarity with the measured map.
    intervals : dict
        Bounds of the central 95 % of the resamples, for each of these five numbers by name; empty without resamples.
    at_edge : tuple of str
        "mean" and "rsd" if they are at an end of the grid: the best energies may then be beyond it.
    """

    perturbation: object
    mean: float
    rsd: float
    rollup_fraction: float
    true_mean: float
    true_standard_deviation: float
    score: Score
    intervals: dict
    at_edge: tuple

    def to_dict(self) -> dict[str, Any]:
        """Return the optimum in plain types, dict."""
        return asdict(self) | {"perturbation": to_dict(self.perturbation), "score": self.score._asdict()}

    def bounded(self, name: str) -> str:
        """Text of one of the numbers and its interval, str."""
        return self.scaled(name, 1.0)

    def scaled(self, name: str, factor: float) -> str:
        """Text of one of the numbers and its interval, times a factor, str."""
        value = f"{getattr(self, name) * factor:.3g}"
        if not self.intervals:
            return value
        low, high = (bound * factor for bound in self.intervals[name])
        return f"{value} ({low:.3g} to {high:.3g})"


@dataclass(frozen=True, eq=False, repr=False)
class Study:
    """Similarity of simulated maps with a measured one for a grid of energies; result of `fit_energies`.

    Matrices have the shape (rollup fractions, relative standard deviations, means).

    Parameters
    ----------
    grid : EnergyGrid
        Mechanism and energies.
    ssim, errors : ndarray
        Structural similarity at every point of the grid (noise-corrected unless switched off in `settings`), and its
        standard deviation over the resamples. With the correction it is about 1 for the true energies: 0.97 to 1.06 in
        twin experiments, and larger if both maps have common noise, such as two maps of one run.
    shares : ndarray
        Fraction of the resamples in which a point is the best.
    resampled : ndarray
        Similarities in every resample, shape (resamples, a, b, c).
    optimum, refined : Optimum
        The best point of the grid, and the maximum of a spline around it.
    baselines : dict of Score
        Similarity of "unperturbed" and "thermal" maps.
    plain : dict of Score
        Uncorrected structural similarity of "unperturbed", "thermal" and "optimum", for comparison with the ceiling.
    gain : Score
        Similarity of the optimum minus that of the unperturbed map, for paired resamples.
    gain_share : float
        Fraction of the resamples in which the optimum is better than the unperturbed map.
    ceiling : Score or None
        Uncorrected structural similarity of two random halves of the measured ions; None for a map of densities.
    registration : Registration
        Transform of simulated hits into the measured frame.
    measured : DetectorMap
        The measured map; its mask is the compared region.
    maps : dict of DetectorMap
        Simulated maps in the measured frame: "unperturbed", "thermal", "optimum".
    settings : StudySettings
        Settings of the comparison, the random draws and the resampling.
    provenance : dict
        All other input of the study, in plain types: run, measured map, bins, rounds of the registration.
    """

    grid: EnergyGrid
    ssim: np.ndarray
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
    settings: StudySettings
    provenance: dict

    def compared(self, map: DetectorMap) -> DetectorMap:
        """Prepare a map of the measured frame as for the comparison: common region, flattened and smoothed."""
        flat = replace(map, mask=self.measured.mask).flattened(self.settings.flattening or 0.0)
        return flat.smoothed(self.settings.smoothing)

    def to_dict(self) -> dict[str, Any]:
        """Return results and settings in plain types, NaN as None, dict."""
        results: dict[str, Any] = {"made_by": f"apt_evap {__version__}", "grid": asdict(self.grid)}
        results |= {name: getattr(self, name) for name in ("ssim", "errors", "shares", "gain_share")}
        results |= {name: getattr(self, name).to_dict() for name in ("optimum", "refined", "registration")}
        results |= {name: getattr(self, name) and getattr(self, name)._asdict() for name in ("gain", "ceiling")}
        for group in ("baselines", "plain"):
            results[group] = {name: score._asdict() for name, score in getattr(self, group).items()}
        return plain(
            results | {"real_energies": self.real_energies, "settings": asdict(self.settings) | self.provenance}
        )

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

    def __repr__(self) -> str:
        best, refined = self.optimum, self.refined
        combined = self.grid.mechanism == "combined"
        fraction = f", roll-up fraction {best.rollup_fraction:g}" if combined else ""
        edge = f" (at the end of the grid in {' and '.join(best.at_edge)})" if best.at_edge else ""
        others = [f"{name} {score}" for name, score in self.baselines.items()]
        uncorrected = f";\n uncorrected {self.plain['optimum']}, " if self.settings.allow_noise else ", "
        others = f"{', '.join(others)}, gain over unperturbed {self.gain}" + (uncorrected if self.ceiling else "")
        others += f"two halves of the measured ions {self.ceiling}" if self.ceiling else ""
        between = f"{refined.bounded('mean')} eV, sigma/mean {refined.bounded('rsd')}"
        between += f", roll-up fraction {refined.bounded('rollup_fraction')}" if combined else ""
        doubtful = ", registration doubtful" if self.registration.doubtful else ""
        return (
            f"<Study: {self.grid.mechanism}{doubtful}, best at {best.mean:g} eV, sigma/mean {best.rsd:g}{fraction}"
            f"{edge}, SSIM {best.score}; {others};\n between points {between}; {self._energies()}>"
        )

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

    def _energies(self):
        """Text of the refined energies: in real units first, then at the simulated voltage."""
        refined, run, real = self.refined, self.provenance["run"], self.provenance.get("real_units")
        radius = run["tip"].get("apex_radius")
        place = f" at {run['voltage']:g} V" + (f" and R = {radius:.3g} nm" if radius else "")

        def text(factor):
            mean, deviation = (refined.scaled(name, factor) for name in ("true_mean", "true_standard_deviation"))
            return f"{mean} ± {deviation} eV"

        if real is None:
            return f"energies {text(1.0)}{place}"
        field, charge = f"{real['operating_field']:.3g} V/nm", f"{real['flight_charge']}+"
        return (
            f"energies {text(real['real_per_study'])} at {field} and {charge}; "
            f"simulated {text(real['simulated_per_study'])}{place}, {real['barrier_charge']}+"
        )


def plain(value: Any) -> Any:
    """Return a value in the types of JSON; NaN and infinity become None."""
    if isinstance(value, dict):
        return {str(key): plain(each) for key, each in value.items()}
    if isinstance(value, list | tuple):
        return [plain(each) for each in value]
    if isinstance(value, np.ndarray | np.generic):
        return plain(value.tolist())
    if isinstance(value, float):
        return value if np.isfinite(value) else None
    return value if value is None or isinstance(value, bool | int | str) else repr(value)
