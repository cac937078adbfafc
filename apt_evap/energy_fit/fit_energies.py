"""The search for the emission energies whose simulated map looks most like a measured one."""

import warnings
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from apt_evap._common.threads import thread_count
from apt_evap._common.validation import check_count, check_kind
from apt_evap._common.warnings import MapWarning, RegistrationWarning, ResponseWarning
from apt_evap.analysis.similarity import WINDOW
from apt_evap.detection.detector_map import DetectorMap
from apt_evap.detection.hits import Hits
from apt_evap.emission.energies import Thermal
from apt_evap.emission.perturbations import LateralVelocity, Unperturbed
from apt_evap.energy_fit.defaults import MEANS, RSDS
from apt_evap.energy_fit.grid import EnergyGrid, maxima
from apt_evap.energy_fit.search import EnergySearch, registered
from apt_evap.energy_fit.settings import StudySettings
from apt_evap.energy_fit.study import Score, Study, plain
from apt_evap.registration.register import Registration
from apt_evap.simulation.run import Run

BINS = 128
DRAWN = 10
"""Simulated over measured ions that draws of the same ions are to come to, where `FEWEST` to `MOST` of them do."""
FEWEST, MOST = 4, 16
FEWEST_IONS = 0.5
"""Simulated ions in a bin below which there is a warning; studies of tutorials and twins have 1 to 10."""


def fit_energies(
    run: Run,
    measured: Hits | DetectorMap,
    mechanism: str = "roll-up",
    *,
    means: Sequence[float] = MEANS,
    rsds: Sequence[float] = RSDS,
    rollup_fractions: Sequence[float] | None = None,
    registration: Registration | None = None,
    bins: int | None = None,
    smoothing: float | None = None,
    flattening: float | None = None,
    data_range: float = 2.0,
    temperature: float = 50.0,
    allow_noise: bool = True,
    replicas: int | None = None,
    resamples: int = 200,
    seed: int = 0,
    n_threads: int | None = None,
    progress: bool | None = None,
) -> Study:
    r"""Find the emission energies for which a run looks most like a measurement.

    Maps for every energy follow from the responses of one run. They are carried into the measured frame, binned on the
    measured bins and compared by structural similarity where both show something: inside the mask of the measured map
    and inside the convex outlines (as in `DetectorMap.from_hits`) of that map, of the unperturbed map and of that of
    the middle of the grid. The same region serves all energies.

    Parameters
    ----------
    run : Run
        A run with responses.
    measured : Hits or DetectorMap
        Measured ions, or a map of counts or of densities; densities have no noise of their own to draw from.
    mechanism : {"roll-up", "lateral", "combined"}
        How ions start: `RollUp`, `LateralVelocity` or `Combined`.
    means, rsds : sequence of float
        Means of the truncated normal distributions [eV], and standard deviations over the means; those of the paper
        by default.
    rollup_fractions : sequence of float, optional
        Shares of the roll-up for "combined"; those of the paper by default.
    registration : Registration, optional
        Carries simulated hits into the measured frame. By default it is found by `register`, with the middle of the
        grid and then again with the best point, until that stays, and then moved to where that point is most alike.
    bins : int, optional
        Bins along the longer side: of measured hits, 128 by default; of a map, those it has are merged by a whole
        factor to come closest, and stay as they are by default.
    smoothing : float, optional
        Standard deviation of a Gaussian for both maps [mm]; by default half a bin for counts, one for densities, whose
        noise is not known.
    flattening : float, optional
        Both maps are divided by themselves, smoothed with this standard deviation [mm]; 0 for not. By default
        0.15 of the square root of the area compared. Gradients across a measured map that come from the instrument, or
        from the shape of the specimen, follow no energy.
    data_range : float
        As for `ssim`.
    temperature : float
        Temperature of the thermal baseline, lateral velocities of Maxwell and Boltzmann [K].
    allow_noise : bool
        Whether the similarity allows for the noise of both maps; see the notes. False for `ssim` as it is.
    replicas : int, optional
        Draws of the energy and direction of every ion, added up: the map of an energy has less noise then. By default
        so many that they come to ten times the measured ions, but from 4 to 16.
    resamples : int
        Draws of all measured and simulated ions with replacement, for the errors; 0 for none.
    seed : int
        Seed of the resamples.
    n_threads : int, optional
        Threads; by default the processors this process may use. Results do not depend on it.
    progress : bool, optional
        Whether to show a progress bar; by default if the output is a terminal or a notebook.

    Returns
    -------
    Study

    Raises
    ------
    ValueError
        If the run has no responses, the maps share too small a region, or an argument is out of range.

    Warns
    -----
    UserWarning
        If the registration is doubtful, or the run has too few ions for the bins.

    Notes
    -----
    The method is that of Shaikh et al., arXiv 2509.13744, with errors added. A resample draws every measured bin from
    a Poisson distribution and weighs the ions of the run at random (see `Sampler`); all energies and baselines see the
    same draws. The registration is held fixed.

    Noise is variance, too, and would be taken for contrast: the energies whose map has most contrast would seem best.
    So the similarity of a window of densities x and y is (`local_similarity`)

    .. math:: \frac{2 μ_x μ_y + C_1}{μ_x^2 + μ_y^2 + C_1} \; \frac{2 σ_{xy} + ν_x + ν_y + C_2}{σ_x^2 + σ_y^2 + C_2}

    with the parts ν of the variances that are noise: Poisson's where the measured map holds counts, and that of the
    draws where there are several. The true energies have a similarity of about 1. `Study.plain` has similarities
    without ν, beside which the ceiling stands. Noise of measured densities is not known and stays: their maps look most
    like those with somewhat more contrast than the truth.
    """
    grid = EnergyGrid(mechanism, means, rsds, rollup_fractions)  # type: ignore[arg-type]
    if check_kind(run, "run", Run, "a Run").responses is None:
        raise ValueError(f"run must have responses for fit_energies, got {run!r}")
    measured = _measured_map(measured, bins)
    settings = StudySettings(
        smoothing=max(measured.bin_size) * (0.5 if measured.is_counts else 1) if smoothing is None else smoothing,
        flattening=flattening,
        data_range=data_range,
        allow_noise=allow_noise,
        replicas=_replicas(measured, run) if replicas is None else replicas,
        resamples=resamples,
        seed=seed,
        temperature=temperature,
    )
    replicas = settings.replicas
    search = EnergySearch(run, measured, grid, settings, thread_count(n_threads), progress)
    with warnings.catch_warnings():
        # for every energy anew; what it says is in the settings
        warnings.simplefilter("ignore", ResponseWarning)
        rounds: list[Any] = []
        if registration is None:
            warnings.simplefilter("ignore", RegistrationWarning)  # once, of the last
            registration, rounds = registered(search)
        search.place(registration, settings.resamples)
        values = search.matrix(replicas, "energies")
        cells = maxima(values)
        optimum = search.optimum(cells, replicas)
        refined = search.optimum(search.refine(values, cells, replicas), replicas)
        scores, plain_scores, maps = {}, {}, {}
        for name, perturbation, draws in (
            ("unperturbed", Unperturbed(), 1),
            ("thermal", LateralVelocity(Thermal(settings.temperature)), replicas),
            ("optimum", optimum.perturbation, replicas),
        ):
            maps[name], scores[name], plain_scores[name] = search.map_and_scores(perturbation, draws)
        gain = scores.pop("optimum") - scores["unperturbed"]
    registration.warn_if_doubtful()
    density = maps["unperturbed"].ions / search.comparison.mask.sum()
    if density < FEWEST_IONS:
        warnings.warn(
            f"the run has {density:.2g} ions in a bin that is compared, {FEWEST_IONS:g} or more are needed for a map: "
            f"give fewer bins than {max(measured.values.shape)}, or simulate more ions",
            MapWarning,
            stacklevel=2,
        )
    resampled = values[1:]
    wins = np.ravel_multi_index(cells[1:].T, grid.shape)
    provenance = {
        "bins": measured.values.shape[::-1],
        "bin_size": measured.bin_size,
        "bins_compared": search.comparison.inside.sum(),
        "measured": repr(measured),
        "measured_noise": "Poisson" if measured.is_counts else "not known",
        "registered": rounds or "given",
        "share_above_energy_limit": grid.share_above(run.response_settings.energy_limit),
        "run": {"ions": len(run), "provenance": run.provenance, **run.settings},
    }
    return Study(
        grid=grid,
        ssim=values[0],
        errors=resampled.std(axis=0, ddof=1) if settings.resamples > 1 else np.full(grid.shape, np.nan),
        shares=np.bincount(wins, minlength=values[0].size).reshape(grid.shape) / max(settings.resamples, 1),
        resampled=resampled,
        optimum=optimum,
        refined=refined,
        baselines={name: Score.of_resamples(each) for name, each in scores.items()},
        plain={name: Score.of_resamples(each) for name, each in plain_scores.items()},
        gain=Score.of_resamples(gain),
        gain_share=float((gain[1:] > 0).mean()) if settings.resamples else float("nan"),
        ceiling=search.ceiling(),
        registration=registration,
        measured=search.region,
        maps=maps,
        settings=search.comparison.settings,
        provenance=plain(provenance),
    )


def _replicas(measured, run):
    """Draws of every ion that come to `DRAWN` times the measured ions, whose number densities do not tell."""
    drawn = DRAWN * measured.values.sum() / len(run) if measured.is_counts else 2 * FEWEST
    return int(np.clip(np.ceil(drawn), FEWEST, MOST))


def _measured_map(measured, bins):
    """Map of what was measured, with bins about as many as asked for along the longer side."""
    if bins is not None:
        bins = check_count(bins, "bins", at_least=2 * WINDOW + 1)
    if isinstance(measured, Hits):
        return DetectorMap.from_hits(measured, bins=bins or BINS)
    check_kind(measured, "measured", DetectorMap, "Hits or a DetectorMap")
    if bins is None:
        return measured
    ny, nx = measured.values.shape
    factor = max(1, round(max(nx, ny) / bins))
    rows, columns = ny - ny % factor, nx - nx % factor

    def blocks(values):
        return values[:rows, :columns].reshape(rows // factor, factor, columns // factor, factor)

    inside = blocks(measured.mask)
    # a bin that lies partly outside is outside
    mask, values = inside.all(axis=(1, 3)), blocks(np.where(measured.mask, measured.values, 0)).sum(axis=(1, 3))
    if not mask.any():
        raise ValueError(f"bins={bins} leaves no bin inside {measured!r}")
    edges = {"x_edges": measured.x_edges[: columns + 1 : factor], "y_edges": measured.y_edges[: rows + 1 : factor]}
    ions = int(values[mask].sum()) if measured.is_counts else None
    return replace(measured, values=values, mask=mask, ions=ions, detected=None, **edges)
