"""The search for the emission energies whose simulated map looks most like a measured one."""

import warnings
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from itertools import product
from typing import Any

import numpy as np
from numpy.typing import ArrayLike
from scipy import optimize
from tqdm.auto import tqdm

from apt_evap._arrays import check_count, check_kind, check_number, check_seed, check_switch
from apt_evap._threads import thread_count
from apt_evap._types import Floats
from apt_evap.binning import field_of_view
from apt_evap.energy import Thermal, TruncatedNormal
from apt_evap.energy_grid import MEANS, RSDS, EnergyGrid, maxima, spline_maxima
from apt_evap.hits import Hits
from apt_evap.maps import DetectorMap
from apt_evap.perturbation import LateralVelocity, Perturbation, Unperturbed, to_dict
from apt_evap.register import Registration, register
from apt_evap.resample import WINDOW, Comparison, Sampler, drawn_hits
from apt_evap.run import Run
from apt_evap.study import Optimum, Score, Study, plain

BINS = 128
FLATTENING = 0.15
"""Width of the Gaussian that flattens both maps, over the square root of the area compared."""
INTERVAL = 95.0  # percent of the resamples
DRAWN = 10
"""Simulated over measured ions that draws of the same ions are to come to, where `FEWEST` to `MOST` of them do."""
FEWEST, MOST = 4, 16
FEWEST_IONS = 0.5
"""Simulated ions in a bin below which there is a warning; studies of tutorials and twins have 1 to 10."""
_MOST_ROUNDS = 5  # of registration and search


def fit_energies(
    run: Run,
    measured: Hits | DetectorMap,
    mechanism: str = "roll-up",
    *,
    means: Sequence[float] | None = MEANS,
    rsds: Sequence[float] | None = RSDS,
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
    a Poisson distribution and weighs the ions of the run at random (see `resample`); all energies and baselines see the
    same draws. The registration is held fixed.

    Noise is variance, too, and would be taken for contrast: the energies whose map has most contrast would seem best.
    So the similarity of a window of densities x and y is

    .. math:: \frac{2 μ_x μ_y + C_1}{μ_x^2 + μ_y^2 + C_1} \; \frac{2 σ_{xy} + ν_x + ν_y + C_2}{σ_x^2 + σ_y^2 + C_2}

    with the parts ν of the variances that are noise: Poisson's where the measured map holds counts, and that of the
    draws where there are several. The true energies have a similarity of about 1. `Study.plain` has similarities
    without ν, beside which the ceiling stands. Noise of measured densities is not known and stays: their maps look most
    like those with somewhat more contrast than the truth.
    """
    grid = EnergyGrid(mechanism, means, rsds, rollup_fractions)
    if check_kind(run, "run", Run, "a Run").responses is None:
        raise ValueError(f"run must have responses for fit_energies, got {run!r}")
    thermal = LateralVelocity(Thermal(temperature))
    measured = _measured_map(measured, bins)
    settings = {
        "smoothing": max(measured.bin_size) * (0.5 if measured.is_counts else 1) if smoothing is None else smoothing,
        "flattening": flattening,
        "data_range": check_number(data_range, "data_range", above=0),
        "allow_noise": check_switch(allow_noise, "allow_noise"),
        "replicas": _replicas(measured, run) if replicas is None else check_count(replicas, "replicas", at_least=1),
        "resamples": check_count(resamples, "resamples"),
        "seed": check_seed(seed),
    }
    replicas = settings["replicas"]
    for name in ("smoothing", "flattening"):
        if settings[name] is not None:
            settings[name] = check_number(settings[name], name, at_least=0, unit="mm")
    search = _Search(run, measured, grid, settings, thread_count(n_threads), progress)
    with warnings.catch_warnings():
        # for every energy anew; what it says is in the settings
        warnings.filterwarnings("ignore", message=".*launch above the")
        rounds = []
        if registration is None:
            warnings.filterwarnings("ignore", message="the registration is doubtful")  # once, of the last
            registration, rounds = _registered(search)
        search.place(registration, resamples)
        values = search.matrix(replicas, "energies")
        cells = maxima(values)
        optimum, refined = (
            search.optimum(index, replicas) for index in (cells, search.refine(values, cells, replicas))
        )
        scores, plain_scores, maps = {}, {}, {}
        for name, perturbation in (
            ("unperturbed", Unperturbed()),
            ("thermal", thermal),
            ("optimum", optimum.perturbation),
        ):
            draws = 1 if name == "unperturbed" else replicas
            maps[name], scores[name], plain_scores[name] = search.map_and_scores(perturbation, draws)
        gain = scores.pop("optimum") - scores["unperturbed"]
    registration.warn_if_doubtful()
    shown = maps["unperturbed"].ions / search.comparison.mask.sum()
    if shown < FEWEST_IONS:
        warnings.warn(
            f"the run has {shown:.2g} ions in a bin that is compared, {FEWEST_IONS:g} or more are needed for a map: "
            f"give fewer bins than {max(measured.values.shape)}, or simulate more ions",
            stacklevel=2,
        )
    resampled = values[1:]
    wins = np.ravel_multi_index(cells[1:].T, grid.shape)
    return Study(
        grid=grid,
        ssim=values[0],
        errors=resampled.std(axis=0, ddof=1) if resamples > 1 else np.full(grid.shape, np.nan),
        shares=np.bincount(wins, minlength=values[0].size).reshape(grid.shape) / max(resamples, 1),
        resampled=resampled,
        optimum=optimum,
        refined=refined,
        baselines={name: _score(each) for name, each in scores.items()},
        plain={name: _score(each) for name, each in plain_scores.items()},
        gain=_score(gain),
        gain_share=float((gain[1:] > 0).mean()) if resamples else float("nan"),
        ceiling=search.ceiling(),
        registration=registration,
        measured=search.region,
        maps=maps,
        settings=plain(
            settings
            | {
                "flattening": search.flattening,
                "temperature": thermal.energy.temperature,
                "bins": measured.values.shape[::-1],
                "bin_size": measured.bin_size,
                "bins_compared": search.comparison.inside.sum(),
                "measured": repr(measured),
                "measured_noise": "Poisson" if measured.is_counts else "not known",
                "registered": rounds or "given",
                "share_above_energy_limit": grid.share_above(run.response_settings.energy_limit),
                "run": {"ions": len(run), "provenance": run.provenance, **run.settings},
            }
        ),
    )


class _Search:
    """Similarities of one run with one measured map, in the frame of the registration that `place` gives."""

    def __init__(
        self, run: Run, measured: DetectorMap, grid: EnergyGrid, settings: Any, n_threads: int | None, progress: Any
    ) -> None:
        self.run, self.measured, self.grid, self.settings = run, measured, grid, settings
        self.n_threads = n_threads
        self.middle = tuple(number // 2 for number in grid.shape)
        self.disable = None if progress is None else not progress

    def place(self, registration: Registration, resamples: int) -> None:
        """Take a registration: find the region that measured and simulated maps show."""
        region = self.measured
        mask = region.mask & field_of_view(np.where(region.mask, region.values, 0))
        for perturbation in (Unperturbed(), self.perturbation(self.middle)):
            hits = registration.hits(self.run.hits(perturbation))
            mask &= field_of_view(DetectorMap.from_hits(hits, like=region, quantum=None).counts)
        self.region = region = replace(
            region, mask=mask, ions=int(region.values[mask].sum()) if region.is_counts else None
        )
        self.flattening = self.settings["flattening"]
        if self.flattening is None:
            self.flattening = FLATTENING * float(np.sqrt(mask.sum() * np.prod(region.bin_size)))
        seed, smoothing, data_range = (self.settings[name] for name in ("seed", "smoothing", "data_range"))
        self.comparison = Comparison(
            region, smoothing, self.flattening, data_range, resamples, (seed, 0), self.settings["allow_noise"]
        )
        self.sampler = Sampler(self.run, registration, region, self.comparison.box, resamples, (seed, 1))

    def perturbation(self, index: ArrayLike) -> Perturbation:
        """Perturbation at an index of the grid."""
        return self.grid.perturbation(*self.grid.values_at(index))

    def hits(self, index: ArrayLike) -> Hits:
        """Hits of some draws of all ions at an index of the grid, in the frame of the run."""
        drawn = [drawn_hits(self.run, self.perturbation(index), replica) for replica in range(FEWEST)]
        return Hits(**{name: np.concatenate([getattr(hits, name) for hits in drawn]) for name in ("x", "y")})

    def polished(self, registration: Registration, index: ArrayLike) -> Registration:
        """The transform near a registration that makes the map of a point of the grid most alike.

        Of maps whose lines all meet in one pole `register` may miss the scale: by 1.7 % in a twin experiment (Ni[111],
        R = 40 a, 200,000 ions, lateral energies), by 0.05 % after this.
        """
        region, hits = self.region, self.hits(index)
        bin_size = max(region.bin_size)
        smoothing = max(self.settings["smoothing"], bin_size)  # less is too rough a ground to search on
        others = self.settings["data_range"], 0, 0, self.settings["allow_noise"]
        comparison = Comparison(region, smoothing, self.flattening, *others)

        def moved(steps):
            turn, stretch, x, y = steps * np.array([0.5, 0.015, bin_size, bin_size])  # degrees, logarithm, mm
            shift = registration.shift[0] + x, registration.shift[1] + y
            turned = {"rotation": registration.rotation + turn, "scale": registration.scale * np.exp(stretch)}
            return replace(registration, shift=shift, **turned)

        def unlike(steps):
            counts = DetectorMap.from_hits(moved(steps).hits(hits), like=region, quantum=None).counts
            return -comparison.similarities(counts[comparison.box][None])[0]

        simplex = np.vstack([np.zeros(4), np.eye(4)])
        options = {"initial_simplex": simplex, "xatol": 0.01, "fatol": 1e-5, "maxfev": 200}
        bounds = optimize.Bounds(np.full(4, -4.0), np.full(4, 4.0))
        best = optimize.minimize(unlike, simplex[0], method="Nelder-Mead", bounds=bounds, options=options)
        return moved(best.x)

    def scores(self, perturbation: Any, replicas: int) -> Floats:
        """Similarity of all ions, and of each resample, shape (1 + resamples,)."""
        return self.comparison.similarities(*self.sampler.maps(perturbation, replicas))

    def matrix(self, replicas: int, note: Any, places: Any = None) -> Floats:
        """Similarities at places on the three axes, the whole grid by default; shape (1 + resamples, a, b, c)."""
        places = [np.arange(number) for number in self.grid.shape] if places is None else places
        tried = [self.perturbation(index) for index in product(*places)]
        with (
            ThreadPoolExecutor(self.n_threads) as pool,
            tqdm(total=len(tried), unit=" maps", desc=note, disable=self.disable) as bar,
        ):

            def scores(perturbation):
                found = self.scores(perturbation, replicas)
                bar.update()
                return found

            values = np.stack(list(pool.map(scores, tried)), axis=1)
        return values.reshape(-1, *map(len, places))

    def refine(self, values: Floats, cells: Any, replicas: int) -> Floats:
        """Places of the maxima between the points, shape (1 + resamples, 3).

        They are looked for within a step of the best point; a resample whose best point lies elsewhere keeps that.
        """
        places = self.grid.around(cells[0])
        found = spline_maxima(places, self.matrix(replicas, "between points", places))
        low, high = (np.array([along[end] for along in places]) for end in (0, -1))
        near = ((low <= cells) & (cells <= high)).all(axis=1)
        return np.where(near[:, None], found, cells)

    def optimum(self, index: Any, replicas: int) -> Optimum:
        """The `Optimum` at an index of the grid, shape (1 + resamples, 3), those of the resamples for its intervals."""
        fraction, rsd, mean = self.grid.values_at(index).T
        energies = [TruncatedNormal(m, s * m) for m, s in zip(mean, rsd, strict=True)]
        numbers = {
            "mean": mean,
            "rsd": rsd,
            "rollup_fraction": fraction,
            "true_mean": np.array([energy.true_mean for energy in energies]),
            "true_standard_deviation": np.array([energy.true_standard_deviation for energy in energies]),
        }
        tails = (100 - INTERVAL) / 2
        intervals = {
            name: tuple(np.percentile(values[1:], [tails, 100 - tails]).tolist())
            for name, values in numbers.items()
            if len(values) > 1
        }
        best = {name: float(values[0]) for name, values in numbers.items()}
        perturbation = self.perturbation(index[0])
        ends = tuple(
            name for axis, name in ((2, "mean"), (1, "rsd")) if index[0, axis] in (0, self.grid.shape[axis] - 1)
        )
        return Optimum(
            perturbation=perturbation,
            **best,
            score=_score(self.scores(perturbation, replicas)),
            intervals=intervals,
            at_edge=ends,
        )

    def map_and_scores(self, perturbation: Any, replicas: int) -> tuple[DetectorMap, Floats, Floats]:
        """The simulated map on the measured bins, its similarities and those with noise, shape (1 + resamples,)."""
        drawn, noise = self.sampler.maps(perturbation, replicas)
        counts = np.zeros(self.region.values.shape, np.int64)
        counts[self.comparison.box] = drawn[0]
        ions = int(counts[self.region.mask].sum())
        source = f"simulation, {perturbation!r}"
        simulated = replace(
            self.region, values=counts, is_counts=True, ions=ions, quantum=None, smoothing=0, source=source
        )
        return simulated, *(self.comparison.similarities(drawn, noise, plain=plain) for plain in (False, True))

    def ceiling(self) -> Any:
        """Similarity of two halves of the measured ions, None for densities."""
        if not self.measured.is_counts:
            return None
        halves = self.comparison.ceiling(max(self.settings["resamples"], 20), (self.settings["seed"], 2))
        return Score(float(halves.mean()), float(halves.std(ddof=1)))


def _registered(search):
    """Register with the middle of the grid, then with the best point, until that stays; polished, and the rounds."""
    registration, best, rounds = None, search.middle, []
    for _ in range(_MOST_ROUNDS):
        registration = register(search.hits(best), search.measured, start=registration)
        rounds.append({"perturbation": to_dict(search.perturbation(best)), "registration": registration.to_dict()})
        search.place(registration, 0)
        found = tuple(maxima(search.matrix(FEWEST, "registration"))[0])
        if found == best:
            break
        best = found
    return search.polished(registration, best), rounds


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
    return replace(measured, values=values, mask=mask, ions=ions, **edges)


def _score(similarities):
    """Value of all ions, and the standard deviation over the resamples."""
    error = similarities[1:].std(ddof=1) if len(similarities) > 2 else np.nan
    return Score(float(similarities[0]), float(error))
