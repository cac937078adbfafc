"""What a search for emission energies found: similarities, the best energies, how sure they are."""

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
    """A similarity and its standard deviation over the resamples, NaN without any."""

    value: float
    error: float

    @classmethod
    def of_resamples(cls, similarities: Floats) -> "Score":
        """The first similarity, that of all ions, with the standard deviation over the others, of resamples."""
        error = similarities[1:].std(ddof=1) if len(similarities) > 2 else np.nan
        return cls(float(similarities[0]), float(error))

    def __str__(self):
        return f"{self.value:z.3f}" + (f" ± {self.error:.3f}" if np.isfinite(self.error) else "")


@dataclass(frozen=True)
class Optimum:
    """Energies at which a simulated map is most like the measured one.

    Parameters
    ----------
    perturbation : perturbation
        How the ions start.
    mean : float
        Mean of the energy before the cut [eV].
    rsd : float
        Its standard deviation before the cut, over the mean.
    rollup_fraction : float
        Share of the energy in the roll-up.
    true_mean, true_standard_deviation : float
        Of the energies after the cut [eV].
    score : Score
        Similarity with the measured map.
    intervals : dict
        For each of these five numbers by name, the bounds between which 95 % of the resamples have it; empty without
        resamples.
    at_edge : tuple of str
        "mean" and "rsd" where it lies at an end of the grid, so that the energies may be beyond.
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
        """Return it in plain types, dict."""
        return asdict(self) | {"perturbation": to_dict(self.perturbation), "score": self.score._asdict()}

    def bounded(self, name: str) -> str:
        """Say one of the numbers and its interval, str."""
        value = f"{getattr(self, name):.3g}"
        return f"{value} ({self.intervals[name][0]:.3g} to {self.intervals[name][1]:.3g})" if self.intervals else value


@dataclass(frozen=True, eq=False, repr=False)
class Study:
    """Similarity of simulated maps with a measured one for a grid of energies; made by `fit_energies`.

    Matrices have the shape (rollup fractions, relative standard deviations, means).

    Parameters
    ----------
    grid : EnergyGrid
        Mechanism and energies.
    ssim, errors : ndarray
        Structural similarity at every point of the grid, noise allowed for unless `settings` say otherwise, and its
        standard deviation over the resamples. So allowed for, it is about 1 for the truth: 0.97 to 1.06 in twin
        experiments, and above that where both maps have noise in common, as those of one run.
    shares : ndarray
        Share of the resamples in which a point is the best.
    resampled : ndarray
        Similarities in every resample, shape (resamples, a, b, c).
    optimum, refined : Optimum
        The best point of the grid, and that of a smooth model around it.
    baselines : dict of Score
        Similarity of "unperturbed" and "thermal" maps.
    plain : dict of Score
        Structural similarity, noise and all, of "unperturbed", "thermal" and "optimum": what stands beside the ceiling.
    gain : Score
        Similarity of the optimum less that of the unperturbed map, in pairs of resamples.
    gain_share : float
        Share of the resamples in which the optimum is better than the unperturbed map.
    ceiling : Score or None
        Structural similarity of two random halves of the measured ions, noise and all; None for a map of densities.
    registration : Registration
        Carries simulated hits into the measured frame.
    measured : DetectorMap
        The measured map; its mask is the region compared.
    maps : dict of DetectorMap
        Simulated maps in the measured frame: "unperturbed", "thermal", "optimum".
    settings : StudySettings
        How maps were compared, drawn and resampled.
    provenance : dict
        Everything else the study was made with, in plain types: run, measured map, bins, rounds of the registration.
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
        """Return a map of the measured frame as it is compared: in the common region, flattened and smoothed."""
        flat = replace(map, mask=self.measured.mask).flattened(self.settings.flattening or 0.0)
        return flat.smoothed(self.settings.smoothing)

    def to_dict(self) -> dict[str, Any]:
        """Return results and settings in plain types, NaN as None, dict."""
        results = {"made_by": f"apt_evap {__version__}", "grid": asdict(self.grid)}
        results |= {name: getattr(self, name) for name in ("ssim", "errors", "shares", "gain_share")}
        results |= {name: getattr(self, name).to_dict() for name in ("optimum", "refined", "registration")}
        results |= {name: getattr(self, name) and getattr(self, name)._asdict() for name in ("gain", "ceiling")}
        for group in ("baselines", "plain"):
            results[group] = {name: score._asdict() for name, score in getattr(self, group).items()}
        return plain(results | {"settings": asdict(self.settings) | self.provenance})

    def save(self, path: AnyPath) -> None:
        """Write results and settings to a JSON file, whole or not at all.

        Parameters
        ----------
        path : str or path-like
            The file to write or overwrite.

        Raises
        ------
        FileError
            If it cannot be written.
        """
        with replace_file(path) as file:
            file.write((json.dumps(self.to_dict(), indent=1, allow_nan=False) + "\n").encode())

    def __repr__(self) -> str:
        best, refined = self.optimum, self.refined
        combined = self.grid.mechanism == "combined"
        share = f", roll-up fraction {best.rollup_fraction:g}" if combined else ""
        edge = f" (at the end of the grid in {' and '.join(best.at_edge)})" if best.at_edge else ""
        others = [f"{name} {score}" for name, score in self.baselines.items()]
        noisy = f";\n noise and all {self.plain['optimum']}, " if self.settings.allow_noise else ", "
        others = f"{', '.join(others)}, gain over unperturbed {self.gain}" + (noisy if self.ceiling else "")
        others += f"two halves of the measured ions {self.ceiling}" if self.ceiling else ""
        between = f"{refined.bounded('mean')} eV, sigma/mean {refined.bounded('rsd')}"
        between += f", roll-up fraction {refined.bounded('rollup_fraction')}" if combined else ""
        doubtful = ", registration doubtful" if self.registration.doubtful else ""
        run = self.provenance["run"]
        radius = run["tip"].get("apex_radius")
        scale = f" at {run['voltage']:g} V" + (f" and R = {radius:.3g} nm" if radius else "")
        return (
            f"<Study: {self.grid.mechanism}{doubtful}, best at {best.mean:g} eV, sigma/mean {best.rsd:g}{share}{edge}, "
            f"SSIM {best.score}; {others};\n between points {between}; energies "
            f"{refined.bounded('true_mean')} ± {refined.bounded('true_standard_deviation')} eV{scale}>"
        )


def plain(value: Any) -> Any:
    """Return a value in the types of JSON; NaN and infinities become None."""
    if isinstance(value, dict):
        return {str(key): plain(each) for key, each in value.items()}
    if isinstance(value, list | tuple):
        return [plain(each) for each in value]
    if isinstance(value, np.ndarray | np.generic):
        return plain(value.tolist())
    if isinstance(value, float):
        return value if np.isfinite(value) else None
    return value if value is None or isinstance(value, bool | int | str) else repr(value)
