"""Fit of the specimen: which of several runs, and which emission energies, give the most similar map."""

import warnings
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from apt_evap._common.codec import for_json
from apt_evap._common.files import check_path
from apt_evap._common.types import AnyPath
from apt_evap._common.validation import check_kind
from apt_evap.detection.detector_map import DetectorMap
from apt_evap.detection.hits import Hits
from apt_evap.fit.fit_energies import fit_energies
from apt_evap.fit.fit_settings import FitSettings
from apt_evap.fit.grid import EnergyGrid
from apt_evap.fit.measured_map import measured_map
from apt_evap.fit.study import Study
from apt_evap.maps.registration.register import Registration
from apt_evap.simulation.run import Run, load
from apt_evap.warnings import RegistrationWarning


@dataclass(frozen=True, eq=False, repr=False)
class TipFit:
    """Similarity of several runs with a measured map; result of `fit_tips`.

    Parameters
    ----------
    studies : dict of Study
        Fitted energies by name of the run, all compared in the same region of the measured map.
    shares : dict of float
        Fraction of the resamples in which a run, with its best energies, is the most similar one; NaN without
        resamples.
    doubtful : tuple of str
        Names of the runs with a doubtful registration. Their similarity may be too small.
    failed : dict of str
        Runs that could not be compared: the reason by name.
    """

    studies: dict[str, Study]
    shares: dict[str, float]
    doubtful: tuple[str, ...]
    failed: dict[str, str]

    @property
    def order(self) -> list[str]:
        """Names of the runs by similarity, first those whose maps are alike: scores of others are not comparable."""

        def key(name):
            study = self.studies[name]
            return study.likeness.verdict != "alike", -study.refined.score.value

        return sorted(self.studies, key=key)

    @property
    def best(self) -> str:
        """Name of the run with the largest similarity among those whose maps are alike, or of all if none are."""
        return self.order[0]

    def rows(self) -> list[dict[str, Any]]:
        """Table of the results, in the order of the similarity, in plain types.

        Returns
        -------
        list of dict
            For each run: run, similarity and error (at the maximum between the points of the grid), share,
            unperturbed, gain, mean and standard_deviation (after the truncation, [eV]), mean_low and mean_high (95 %
            of the resamples), relative_spread, rollup_fraction, real_mean and real_standard_deviation
            (real units [eV]), scale, rotation [degrees], mirror, doubtful, likeness (the verdict on the maps) and
            no_energy (why the energies are no result; empty if they are).
        """
        rows = []
        for name in self.order:
            study = self.studies[name]
            best, place = study.refined, study.registration
            real = study.real_energies or (None, None)
            low, high = best.intervals.get("true_mean", (None, None))
            rows.append(
                {
                    "run": name,
                    "similarity": best.score.value,
                    "error": best.score.error,
                    "share": self.shares[name],
                    "unperturbed": study.baselines["unperturbed"].value,
                    "gain": study.gain.value,
                    "mean": best.true_mean,
                    "mean_low": low,
                    "mean_high": high,
                    "standard_deviation": best.true_standard_deviation,
                    "relative_spread": best.relative_spread,
                    "rollup_fraction": best.rollup_fraction,
                    "real_mean": real[0],
                    "real_standard_deviation": real[1],
                    "scale": place.scale,
                    "rotation": place.rotation,
                    "mirror": place.mirror,
                    "doubtful": name in self.doubtful,
                    "likeness": study.likeness.verdict,
                    "no_energy": study.no_energy,
                }
            )
        return for_json(rows)

    def __repr__(self) -> str:
        lines = [f"<TipFit: {len(self.studies)} runs, {len(self.failed)} failed; best {self.best!r}"]
        for name in self.order[:5]:
            study = self.studies[name]
            share = f", best in {self.shares[name]:.0%} of the resamples" if np.isfinite(self.shares[name]) else ""
            doubt = ", registration doubtful" if name in self.doubtful else ""
            alike = study.likeness.verdict == "alike"
            result = f"{study.score_text}; {study.result}" if alike else f"maps {study.likeness.verdict}"
            lines.append(f" {name}: {result}{share}{doubt}")
        return "\n".join(lines) + ">"


def fit_tips(
    runs: Mapping[str, Run | AnyPath],
    measured: Hits | DetectorMap,
    grid: EnergyGrid | None = None,
    settings: FitSettings | None = None,
    *,
    registration: Registration | None = None,
    **options: Any,
) -> TipFit:
    """Find the specimen, and the emission energies, with the largest similarity to a measurement.

    Each run is registered on the measured map and its energies are fitted (`fit_energies`). Similarities of different
    runs can be compared only for the same region. So all runs are then compared again in the region that all simulated
    maps cover, with the registrations of the first comparison and the same flattening. The resamples of the measured
    ions are the same for all runs.

    Parameters
    ----------
    runs : mapping
        Runs with responses, or their files, by name. Files are loaded one after the other.
    measured : Hits or DetectorMap
        Measured ions, or a map.
    grid, settings : optional
        As for `fit_energies`.
    registration : Registration, optional
        Transform of the hits of all runs into the measured frame; by default determined for each run.
    **options
        Other parameters of `fit_energies`.

    Returns
    -------
    TipFit

    Raises
    ------
    ValueError
        If there is no run, none of them can be compared, or an argument is outside its range.

    Notes
    -----
    The runs should have about the same number of ions per area of the detector: the noise of the draws is corrected,
    but not that of the simulated sequence. The region is that of the run with the smallest field of view. A run that
    covers much less than the others should be left out.
    """
    if not check_kind(runs, "runs", Mapping, "a mapping of runs by name"):
        raise ValueError("runs must contain at least one run, got none")
    settings = check_kind(FitSettings() if settings is None else settings, "settings", FitSettings, "FitSettings")
    measured, settings = (
        measured_map(measured, settings.bins),
        replace(settings, bins=None, objective=settings.objective or "similarity"),
    )
    registrations: dict[str, Registration] = {}
    failed: dict[str, str] = {}
    region = measured.mask
    for name, run in runs.items():
        try:
            study = _fit(run, measured, grid, replace(settings, resamples=0), registration=registration, **options)
        except ValueError as error:
            failed[name] = str(error)
            continue
        registrations[name], region = study.registration, region & study.measured.mask
    if not registrations:
        name, reason = next(iter(failed.items()))
        raise ValueError(f"none of {len(failed)} runs can be compared; {name}: {reason}")
    ions = int(measured.values[region].sum()) if measured.is_counts else None
    common = replace(measured, mask=region, ions=ions, detected=None)
    studies = {
        name: _fit(runs[name], common, grid, settings, registration=registration, **options)
        for name, registration in registrations.items()
    }
    names = list(studies)
    # similarity of the best point of each resample, shape (runs, resamples)
    best = np.stack([study.resampled.max(axis=tuple(range(1, study.resampled.ndim))) for study in studies.values()])
    wins = np.bincount(best.argmax(axis=0), minlength=len(names)) if best.shape[1] else np.full(len(names), np.nan)
    shares = dict(zip(names, (wins / max(best.shape[1], 1)).tolist(), strict=True))
    doubtful = tuple(name for name, registration in registrations.items() if registration.doubtful)
    return TipFit(studies, shares, doubtful, failed)


def _fit(run, *arguments, **options):
    """Fit of one run; a doubtful registration is expected for a wrong specimen, and reported once in the result."""
    run = run if isinstance(run, Run) else load(check_path(run))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", RegistrationWarning)
        return fit_energies(run, *arguments, **options)
