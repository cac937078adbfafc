"""Fit of the emission energies: the simulated map that is most like a measured one."""

import math
import warnings
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from apt_evap._common.codec import for_json
from apt_evap._common.threads import thread_count
from apt_evap._common.validation import check_kind
from apt_evap.detection.detector_map import DetectorMap
from apt_evap.detection.hits import Hits
from apt_evap.emission.energies import Thermal
from apt_evap.emission.perturbations import LateralVelocity, Perturbation, RollUp, Unperturbed
from apt_evap.fit.comparison import FoldedComparison
from apt_evap.fit.energy_search import EnergySearch, register_repeatedly
from apt_evap.fit.fit_settings import FitSettings
from apt_evap.fit.grid import EnergyGrid, maxima
from apt_evap.fit.intervals import intervals as intervals_of
from apt_evap.fit.measured_map import FEWEST_IONS, bins_for_run, measured_map
from apt_evap.fit.structure import PoleMeasure, StructureScores
from apt_evap.fit.study import RULE_OF_METAL, Score, Study
from apt_evap.maps.crystallography.orientation import Orientation
from apt_evap.maps.registration.register import Registration
from apt_evap.simulation.apex import image_compression
from apt_evap.simulation.description import microscope_of
from apt_evap.simulation.run import Run
from apt_evap.warnings import MapWarning, RegistrationWarning, ResponseWarning, StructureWarning, warn

DRAWN = 10
"""Target ratio of simulated (all draws) to measured ions, with `FEWEST` to `MOST` draws per ion."""
FEWEST, MOST = 4, 16
# s of one processor for a launch, and for a map beside its launches. Measured (AMD EPYC) with tungsten, 10,120 and
# 33,008 ions, 16 draws: 30 and 91 s for 305 maps; folded maps of nickel, 10,192 ions, 8 draws: 27 s; aluminium, 16
# draws: 10 s for 61 maps. Later, on a busy machine, the estimate of nickel (305 maps, 8 draws) was 24 s for 28 s with
# 13,384 ions, and 13.7 s for 13.0 s with 5,000
_PER_LAUNCH, _PER_MAP = 0.5e-6, 25e-3


def fit_energies(
    run: Run,
    measured: Hits | DetectorMap,
    grid: EnergyGrid | None = None,
    settings: FitSettings | None = None,
    *,
    registration: Registration | None = None,
    pole: Sequence[int] | None = None,
    n_threads: int | None = None,
    progress: bool | None = None,
) -> Study:
    r"""Find the emission energies whose map of a run is most like a measured one.

    The maps for all energies follow from the responses of one run. They are transformed into the measured frame, binned
    on the measured bins, and compared by the concordance of maps folded about a pole, or by structural similarity
    (`FitSettings.objective`). The compared region is the same for all energies: the mask of the measured map, within
    the convex outlines (as in `DetectorMap.from_hits`) of the measured map, of the unperturbed map and of the map in
    the middle of the grid.

    Parameters
    ----------
    run : Run
        A run with responses.
    measured : Hits or DetectorMap
        Measured ions, or a map of counts or of densities. The noise of densities is not known.
    grid : EnergyGrid, optional
        Mechanism of emission and energies; by default ``EnergyGrid("roll-up")`` with the energies of Shaikh et
        al. (2025).
    settings : FitSettings, optional
        Bins, smoothing, draws and resamples.
    registration : Registration, optional
        Transform of simulated hits into the measured frame. By default determined by `register` with the middle of the
        grid, repeated with the best point until this is stable, and then refined to the largest similarity of this
        point.
    pole : sequence of int, optional
        Miller indices of the pole to fold about and of the rings (`Study.structure`); by default the one with the most
        complete rings inside the compared region.
    n_threads : int, optional
        Number of threads; by default the number of processors that this process may use. Results do not depend on it.
    progress : bool, optional
        Whether to show a progress bar; by default if the output is a terminal or a notebook.

    Returns
    -------
    Study

    Raises
    ------
    ValueError
        If the run has no responses, the common region is too small, or an argument is outside its range.

    Warns
    -----
    UserWarning
        If the registration is doubtful, the run has too few ions for the bins, or the best map has lost the structure
        of the measured one (`StructureWarning`).

    Notes
    -----
    The method is that of Shaikh et al., arXiv 2509.13744, with additional errors. A resample draws every measured bin
    from a Poisson distribution and uses random weights of the ions of the run (see `Sampler`). The draws are the same
    for all energies and baselines. The registration is fixed.

    Noise adds variance, which would count as contrast: the energies of the map with the highest contrast would seem
    best. So the similarity of a window of densities x and y is (`local_similarity`)

    .. math:: \frac{2 μ_x μ_y + C_1}{μ_x^2 + μ_y^2 + C_1} \; \frac{2 σ_{xy} + ν_x + ν_y + C_2}{σ_x^2 + σ_y^2 + C_2}

    with the noise variances ν: Poisson noise for measured counts, and the noise of several draws per ion. The true
    energies have a similarity of about 1. `Study.plain` contains similarities without ν, for comparison with the
    ceiling. The noise of measured densities is not known and not corrected: their best energies have slightly more
    contrast than the true ones.

    Examples
    --------
    >>> run = ae.Simulation(ae.Tip("Ni", apex_radius=2.5, axis=(1, 1, 1)), seed=1).run(1_000)
    >>> measured = run.hits(ae.RollUp(0.2)).map(bins=16, extent=(-60, 60, -60, 60))  # energy to be found
    >>> identity = ae.Registration(rotation=0.0, scale=1.0, shift=(0.0, 0.0))
    >>> grid = ae.fit.EnergyGrid("roll-up", means=(0.1, 0.2, 0.3))
    >>> study = ae.fit_energies(run, measured, grid, ae.fit.FitSettings(resamples=0), registration=identity)
    >>> print(f"{study.optimum.mean} eV")
    0.2 eV
    """
    grid = check_kind(EnergyGrid() if grid is None else grid, "grid", EnergyGrid, "an EnergyGrid")
    settings = check_kind(FitSettings() if settings is None else settings, "settings", FitSettings, "FitSettings")
    check_kind(run, "run", Run, "a Run").require_responses()
    if registration is not None:
        check_kind(registration, "registration", Registration, "a Registration")
    hits_or_map, asked = measured, settings.bins

    def search_with(bins):
        measured = measured_map(hits_or_map, bins)
        completed = _completed(replace(settings, bins=bins), measured, run)
        return EnergySearch(run, measured, grid, completed, thread_count(n_threads), progress)

    search = search_with(asked)
    with warnings.catch_warnings():
        # once per energy; the settings contain the same information
        warnings.simplefilter("ignore", ResponseWarning)
        # the transform onto the measured map, which stays fixed from here on
        registration, rounds = (registration, []) if registration is not None else _registered(search)
        search.place(registration, settings.resamples)
        # bins in which the run has enough ions, unless they are given
        merged = isinstance(hits_or_map, DetectorMap)
        if asked is None and (bins := bins_for_run(run, search.measured, registration, merged)) is not None:
            search = search_with(bins)
            search.place(registration, settings.resamples)

        # scores of the maps of all energies, for all ions and for each resample
        measure, missing = _pole_measure(search, registration, pole)
        search.comparison = _comparison(search, measure, missing)
        settings = search.comparison.settings
        values, structures = search.matrix("energies", measure=measure)

        # best energies: of the grid, and between its points, with their intervals
        cells = maxima(values)
        best = search.refine(values, cells)[0]
        bounds = intervals_of(grid, values, best, *settings.allowed_errors) if settings.resamples else None
        optimum = search.optimum(cells[0], bounds)
        refined = search.optimum(best, bounds)

        # maps at these energies and without perturbation, for comparison
        maps, scores, plain_scores = _compared_maps(search, optimum.perturbation)
        gain = scores.pop("optimum") - scores["unperturbed"]
        structure = _structure_scores(measure, search, structures, maps, cells[0])
    registration.warn_if_doubtful()
    _warn_of_lost_lines(structure, settings)
    _warn_of_few_ions(maps["unperturbed"].ions / search.comparison.mask.sum(), asked)
    return Study(
        grid=grid,
        scores=values[0],
        errors=values[1:].std(axis=0, ddof=1) if settings.resamples > 1 else np.full(grid.shape, np.nan),
        shares=_shares(cells[1:], grid.shape),
        resampled=values[1:],
        optimum=optimum,
        refined=refined,
        baselines={name: Score.of_resamples(resamples) for name, resamples in scores.items()},
        plain={name: Score.of_resamples(resamples) for name, resamples in plain_scores.items()},
        gain=Score.of_resamples(gain),
        gain_share=float((gain[1:] > 0).mean()) if settings.resamples else float("nan"),
        ceiling=search.ceiling(),
        registration=registration,
        measured=search.region,
        maps=maps,
        structure=structure,
        settings=settings,
        provenance=_provenance(run, search, rounds, missing),
    )


def _completed(settings, measured, run):
    """Settings with a smoothing and a number of draws, which follow from the map and the run."""
    bin_size = max(measured.bin_size) * (0.5 if measured.is_counts else 1)
    smoothing = bin_size if settings.smoothing is None else settings.smoothing
    return replace(settings, smoothing=smoothing, replicas=settings.replicas or draws_per_ion(measured, len(run)))


def _registered(search):
    """Registration of a run, and the rounds of its search; its warning is given once, for the last one."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", RegistrationWarning)
        return register_repeatedly(search)


def _compared_maps(search, best):
    """Maps, scores and scores without noise correction, by name: of the baselines and the best energies."""
    thermal = LateralVelocity(Thermal(search.settings.temperature))
    perturbations = {"unperturbed": Unperturbed(), "thermal": thermal}
    if (rule := _rule_of_metal(search.run)) is not None:
        perturbations[RULE_OF_METAL] = rule
    maps, scores, plain_scores = {}, {}, {}
    for name, perturbation in (perturbations | {"optimum": best}).items():
        maps[name], scores[name], plain_scores[name] = search.map_and_scores(perturbation)
    return maps, scores, plain_scores


def _rule_of_metal(run: Run) -> Perturbation | None:
    """`RollUp.of_metal`, as `start` writes it; None unless a pure metal at a constant potential has its responses."""
    charges = dict(run.settings.get("rule") or {}).get("name")
    crystal = Orientation.known(run.settings["tip"])
    if charges != "ConstantPotential" or run.emissions.charge_ratios is None or crystal is None:
        return None
    if crystal.material.cohesive_energy is None or len(set(run.elements)) > 1:
        return None
    scale = float(np.median(run.at_evaporation_field().energy_scales)) if run.units is None else 1.0
    rule = RollUp.of_metal(crystal.material, energy_scale=scale)
    return rule if rule.height <= run.response_model.settings.height else None


def _shares(cells, shape):
    """Fraction of the resamples in which each point of the grid is the best one."""
    wins = np.bincount(np.ravel_multi_index(cells.T, shape), minlength=math.prod(shape))
    return wins.reshape(shape) / max(len(cells), 1)


def _warn_of_lost_lines(structure, settings):
    if structure is not None and structure.lost:
        warn(
            f"the best map by {settings.score_name} has lost the zone lines of the measured map: contrasts "
            f"{_contrasts(structure.optimum)} in the rings about a pole, measured {_contrasts(structure.measured)}; "
            "see Study.structure",
            StructureWarning,
        )


def _warn_of_few_ions(density, bins):
    if density < FEWEST_IONS:
        warn(
            f"the run has {density:.2g} ions per compared bin, but a map needs at least {FEWEST_IONS:g}",
            MapWarning,
            f"{'' if bins is None else f'use fewer bins than {bins}, or '}simulate more ions",
        )


def _provenance(run, search, rounds, missing):
    """Origin of a study: the maps, the run and the registration, in plain types."""
    measured = search.measured
    energy_limit = run.response_settings.energy_limit / np.median(run.energy_scales)  # [eV] of this run
    provenance = {
        "map_bins": measured.values.shape[::-1],
        "bin_size": measured.bin_size,
        "bins_compared": search.comparison.inside.sum(),
        "measured": repr(measured),
        "measured_noise": "Poisson" if measured.is_counts else "not known",
        "registered": rounds or "given",
        "share_above_energy_limit": search.grid.share_above(energy_limit),
        "run": {"ions": len(run), "provenance": run.provenance, **run.settings},
        "real_units": real_units_of(run),
        "microscope": microscope_of(run),
        "structure": missing,
        "projection": _projection_of(run),
    }
    return for_json(provenance)


def _projection_of(run):
    """Scale and compression of the detector of a run; None if it has too few ions."""
    try:
        projection = image_compression(run).projection
    except ValueError:
        return None
    return {"scale": projection.scale, "compression": projection.compression}


def _pole_measure(search, registration, pole):
    """Measure of the structure about a pole, or None and the reason."""
    try:
        return PoleMeasure(search.run, registration, search.region, pole), None
    except ValueError as error:
        if pole is not None:
            raise
        return None, str(error)


def _comparison(search, measure, missing):
    """Objective of the comparison: by default folded maps, if there is a pole to fold about."""
    objective = search.settings.objective
    if objective == "similarity":
        return search.comparison
    try:
        if measure is None:
            raise ValueError(f"the maps show no pole to fold about: {missing}")
        settings = replace(search.comparison.settings, objective="folded")
        return FoldedComparison(search.region, settings, measure.cells(search.region))
    except ValueError as error:
        if objective is None:
            return search.comparison
        raise ValueError(f"settings.objective is 'folded', but {error}") from error


def _structure_scores(measure, search, structures, maps, cell):
    if measure is None:
        return None
    measured = measure.structure(search.region)
    misfits = np.array([structure.misfit(measured) for structure in structures])
    correlations = np.array([structure.correlation(measured) for structure in structures])
    misfit, errors = (column.reshape(search.grid.shape) for column in misfits.T)
    at = tuple(int(index) for index in cell)
    return StructureScores(
        plane=measure.plane,
        measured=measured,
        unperturbed=measure.structure(maps["unperturbed"]),
        optimum=structures[int(np.ravel_multi_index(at, search.grid.shape))],
        correlations=correlations.reshape(search.grid.shape),
        misfit=misfit,
        errors=errors,
        best=tuple(int(index) for index in np.unravel_index(misfit.argmin(), misfit.shape)),
        at_optimum=at,
    )


def _contrasts(structure):
    return ", ".join(f"{ring.contrast:.2f}" for ring in structure.rings)


def real_units_of(run: Run) -> dict[str, Any] | None:
    """Operating point of a run, and factors from the energies of a study to real and simulated ones.

    None if the fields of the cap, which real units need, are not in the run.
    """
    try:
        real = run.in_real_units()
    except ValueError:
        return None
    units = real.require_real_units("an operating point")
    # simulated energies per real one, and per one of the study
    scale, study_scale = (float(np.median(one.energy_scales)) for one in (real, run))
    charges, counts = np.unique(real.flight_charges, return_counts=True)
    return {
        "real_per_study": study_scale / scale,
        "simulated_per_study": study_scale,
        "operating_field": units.operating_field,
        "field_reference": units.field_reference,
        "flight_charge": int(charges[counts.argmax()]),
        "barrier_charge": int(np.median(real.emissions.charge_states)),
    }


def draws_per_ion(measured: DetectorMap, ions: int) -> int:
    """Draws of each ion of a run for `DRAWN` times the measured ions; their number is not known for densities."""
    number = DRAWN * measured.values.sum() / ions if measured.is_counts else 2 * FEWEST
    return int(np.clip(np.ceil(number), FEWEST, MOST))


def seconds_of_fit(measured: DetectorMap, grid: EnergyGrid, ions: int) -> float:
    """Processor time of `fit_energies` for a run of so many ions, without a registration [s]."""
    maps = math.prod(grid.shape) + math.prod(map(len, grid.around((0,) * len(grid.shape))))
    return maps * (_PER_MAP + _PER_LAUNCH * ions * draws_per_ion(measured, max(ions, 1)))
