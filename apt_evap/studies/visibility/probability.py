"""Probability that an analysis finds a feature, and how wrong size and composition come out."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
import scipy
from numpy.typing import ArrayLike, NDArray

from apt_evap._common.codec import for_json
from apt_evap._common.types import Booleans, Estimated, Floats, Integers
from apt_evap._common.validation import (
    check_array,
    check_choice,
    check_count,
    check_kind,
    check_number,
    check_seed,
    short_text,
)
from apt_evap.detection.instrument import Instrument
from apt_evap.emission.perturbations import Perturbation
from apt_evap.reconstruction.precipitate import ellipsoid_of
from apt_evap.specimen.phases import Phase
from apt_evap.specimen.regions import Layer, Sphere
from apt_evap.specimen.tip import Tip
from apt_evap.studies.visibility.cases import check_feature, simulated, size_of, specimen_of, values_of, varied
from apt_evap.studies.visibility.operators import OriginOperators, origin_operators
from apt_evap.studies.visibility.recorded import Ions, recorded_ions

MOST_TWINS = 1_000_000
"""Largest number of twins: their results are in memory."""
_RESAMPLES = 200  # of the bootstrap: 5 % of an error
_FEWEST = 10  # ions of a feature for its second moments
_NEAREST, _LEAST_NEAR = 0.2, 20  # fraction and least number of the twins from which a true size is inferred
_WEAK = 1e-3  # weight of a slope of 1: keeps it finite if a threshold separates all twins
_SIZES = ("size", "lateral", "depth", "thickness")


class TrueSize(NamedTuple):
    """True sizes that fit to a measured one."""

    median: float
    """Median [nm]."""
    low: float
    """16th percentile [nm]."""
    high: float
    """84th percentile [nm]."""


class MeasuredError(NamedTuple):
    """Error of a measured quantity."""

    bias: float
    """Mean of measured minus true values."""
    scatter: float
    """Standard deviation of measured minus true values."""
    bias_error: float
    """Standard deviation of the bias."""


class SizedTwins(NamedTuple):
    """Twins of a feature with different sizes; each of shape (m,)."""

    sizes: Floats
    """True size [nm]."""
    ions: Integers
    """Recorded ions of the feature."""
    found: Booleans
    """Whether the analysis finds it."""
    measured: dict[str, Floats]
    """Measured quantities, as in `Visibility.measured`."""


@dataclass(frozen=True, eq=False)
class Visibility:
    """Answer of `estimate`.

    Parameters
    ----------
    size : float
        Size of the feature [nm]; NaN for one without a size.
    p_values : ndarray
        p-value of each twin of the feature, shape (n,).
    measured, true : dict
        Measured and true values of each twin, each of shape (n,). Lengths in nm, composition as a fraction. Those of
        the analysis have its names. "apparent lateral", "apparent depth", "apparent thickness" and "apparent
        composition" are those of an analysis with the true ions of the feature.
    """

    size: float
    significance: float
    p_values: Floats = field(repr=False)
    measured: dict[str, Floats] = field(repr=False)
    true: dict[str, Floats] = field(repr=False)
    sized: SizedTwins | None = field(repr=False)
    operators: OriginOperators | None = field(repr=False)

    @property
    def probability(self) -> Estimated:
        """Probability that the analysis finds the feature: (k + 1) / (n + 2) for k of n twins, Laplace's estimate."""
        n = len(self.p_values)
        p = (np.count_nonzero(self.p_values <= self.significance) + 1) / (n + 2)
        return Estimated(float(p), math.sqrt(p * (1 - p) / (n + 3)))

    @cached_property
    def n50(self) -> Estimated:
        """Recorded ions of the feature with which it is found in 50 % of the twins; see `estimate`."""
        return self._ions_for(0.5)

    @cached_property
    def n95(self) -> Estimated:
        """Recorded ions of the feature with which it is found in 95 % of the twins; see `estimate`."""
        return self._ions_for(0.95)

    @property
    def errors(self) -> dict[str, MeasuredError]:
        """Bias and scatter of each measured quantity with a known true value, dict of MeasuredError."""
        out = {}
        for name, true in self.true.items():
            wrong = (self.measured[name] - true)[np.isfinite(self.measured[name])]
            if len(wrong) > 1:
                scatter = float(np.std(wrong, ddof=1))
                out[name] = MeasuredError(float(np.mean(wrong)), scatter, scatter / math.sqrt(len(wrong)))
        return out

    def true_size(self, measured: ArrayLike, name: str | None = None) -> TrueSize:
        """Distribution of the true size for a measured one, from the twins with different sizes.

        Parameters
        ----------
        measured : float
            The measured size [nm].

        Notes
        -----
        All sizes that were drawn are equally probable before the measurement, per relative change. The true sizes of
        the fifth of the twins (at least 20) with the nearest measured sizes, moved along a line that is fitted to them,
        are the distribution: a regression adjustment.
        """
        if self.sized is None:
            raise ValueError("name must be that of a measured size: this answer has no twins with different sizes")
        known = [quantity for quantity in self.sized.measured if quantity.removeprefix("apparent ") in _SIZES]
        if name is None:
            name = next(iter(quantity for quantity in ("size", *known) if quantity in known), "size")
        seen = self.sized.measured[check_choice(name, "name", known)]
        usable = np.isfinite(seen) & (seen > 0)
        value = math.log(check_number(measured, "measured", above=0, unit="nm"))
        x, y = np.log(seen[usable]), np.log(self.sized.sizes[usable])
        if len(x) < _FEWEST:
            raise ValueError(f"name must be measured in at least {_FEWEST} twins, got {name} in {len(x)}")
        near = np.argsort(np.abs(x - value))[: max(_LEAST_NEAR, round(_NEAREST * len(x)))]
        # the value is the origin, so that the first constant of the line belongs to it
        line = np.column_stack([np.ones(len(near)), x[near] - value])
        inverse = np.linalg.pinv(line)
        fitted = inverse @ y[near]
        # deviation of each twin from the line of the others, and quantiles of a further one: both widen the interval
        apart = (y[near] - line @ fitted) / (1 - np.einsum("ij,ji->i", line, inverse))
        half = min(0.34 * (len(near) + 1) / (len(near) - 1), 0.5)
        low, median, high = np.exp(fitted[0] + np.quantile(apart, [0.5 - half, 0.5, 0.5 + half]))
        return TrueSize(float(median), float(low), float(high))

    def to_dict(self) -> dict[str, Any]:
        """Probability, N50, N95 and errors as numbers, None for NaN, for JSON."""
        names = ("size", "significance", "probability", "n50", "n95", "errors")
        return for_json({name: getattr(self, name) for name in names} | {"twins": len(self.p_values)})

    def _ions_for(self, probability):
        sized = self.sized
        if sized is None:
            return Estimated(math.nan, math.nan)
        random = np.random.default_rng(0)
        rows = random.integers(len(sized.ions), size=(_RESAMPLES, len(sized.ions)))
        drawn = [_threshold(sized.ions[row], sized.found[row], probability) for row in rows]
        value = _threshold(sized.ions, sized.found, probability)
        return Estimated(value, float(np.nanstd(drawn)) if np.isfinite(value) else math.nan)


def estimate_visibility(
    feature: Phase,
    specimen: Tip,
    instrument: Instrument,
    analysis: Callable[[Floats, NDArray[np.int64]], Any],
    *,
    operators: OriginOperators | None = None,
    perturbation: Perturbation | None = None,
    sizes: ArrayLike | None = None,
    reach: float | None = None,
    twins: int = 50,
    permutations: int = 39,
    significance: float = 0.05,
    full: bool | None = None,
    seed: int = 0,
    n_threads: int | None = None,
    **settings: Any,
) -> Visibility:
    """Estimate whether an analysis finds a feature of a specimen, and how wrong its size and composition come out.

    Parameters
    ----------
    feature : Phase
        The feature: a phase with a region in the coordinates of the specimen, a composition and an evaporation field.
    specimen : Tip
        The specimen without it.
    instrument : Instrument
        The instrument.
    analysis : callable
        Your analysis: takes positions (n, 3) [nm] and labels (n,), the elements as indices into their names in
        alphabetical order. It returns a statistic that is larger where there is more of the feature; or a dict with
        "statistic" and measured quantities, such as "size" [nm] and "composition" (a fraction).
    operators : OriginOperators, optional
        From `origin_operators`, of the same feature, specimen, instrument, perturbation and settings; only the values
        of its axes and the efficiency may differ. By default they are made for `sizes`.
    perturbation : perturbation, optional
        Initial conditions of the ions; by default `Unperturbed`.
    sizes : array_like, optional
        Sizes that are simulated for the operators [nm]; by default half, all and twice the size of the feature.
    reach : float, optional
        Give the analysis the ions within this distance from the feature only [nm]; by default all ions.
    twins : int
        Number of twins of the feature, and of those with different sizes.
    permutations : int
        Number of permutations of the labels for each p-value, at least 1/significance - 1.
    significance : float
        A feature is found if the p-value is at most this.
    full : bool, optional
        Whether each twin is a full simulation instead of one of the emulator. By default for features with an order,
        because the emulator blurs neighbours independently, and for those without a size.
    seed : int
        Seed of all twins.
    n_threads, **settings
        As for `Simulation`.

    Returns
    -------
    Visibility

    Raises
    ------
    ValueError
        If an argument is wrong, the operators are those of something else, or the analysis does not return a number.

    Notes
    -----
    The labels are permuted among the positions of the same ions. This null hypothesis is exact and keeps all artefacts
    of the density: p = (k + 1) / (m + 1), if k of m permutations have at least the statistic of the ions. As soon as
    the feature cannot be found any more, the rest is left out, with p = k / m of those so far (Besag and Clifford,
    Biometrika 78, 301 (1991)).

    N50 and N95 are numbers of recorded ions of the feature: where a logistic function of ln N, fitted to the twins with
    different sizes, is 0.5 and 0.95. The sizes are drawn from the range of the operators, uniformly in ln(size). N50
    and N95 are NaN outside the numbers of ions that were drawn.

    Examples
    --------
    >>> import scipy
    >>> region = ae.specimen.Sphere((0, 0, 1.5), 0.7)
    >>> particle = ae.specimen.Phase("particle", "Ni", region, solutes={"Al": 0.8}, evaporation_field=35.0)
    >>> def analysis(positions, labels):
    ...     solutes = scipy.spatial.cKDTree(positions[labels == 0])
    ...     return solutes.count_neighbors(solutes, 0.5)  # pairs of solutes
    >>> tip = ae.Tip("Ni", apex_radius=2.5, solutes={"Al": 0.02}, seed=1)
    >>> instrument = ae.Instrument(field_of_view=160.0)
    >>> answer = ae.studies.estimate_visibility(particle, tip, instrument, analysis, sizes=[0.7], twins=5)
    >>> answer.probability.value > 0.5
    True
    """
    size = size_of(check_feature(feature))
    check_kind(instrument, "instrument", Instrument, "an Instrument")
    if not callable(analysis):
        raise ValueError(f"analysis must be a function of positions and labels, got {analysis!r}")
    twins = check_count(twins, "twins", at_least=1, at_most=MOST_TWINS)
    check_permutations(permutations, significance)
    check_seed(seed)
    arguments = specimen_of(specimen)
    if full and operators is not None:
        raise ValueError("operators must be None if full is True, because they replace the simulations")
    full = is_simulated_in_full(feature) if full is None else full
    # operators in place of full simulations, and the range of the sizes
    axes = None if sizes is None else {"size": sizes}
    if operators is not None:
        operators.check(feature, specimen, instrument, perturbation, axes=axes, n_threads=n_threads, **settings)
    elif not full:
        operators = origin_operators(
            feature, specimen, instrument, perturbation, axes=axes, seed=seed + 1, n_threads=n_threads, **settings
        )
    bounds = np.array([0.5, 2.0]) * size if operators is None else operators.axes.get("size", np.array([size]))
    low, high = float(bounds[0]), float(bounds[-1])
    random = np.random.default_rng(seed)
    test = _Test(analysis, reach, permutations, significance, random)

    def twin(number, value):
        values = {"size": value} if math.isfinite(value) else {}
        variant, chosen = varied(feature, arguments, **values)
        if operators is None:
            run = simulated(variant, chosen, perturbation, seed=number, n_threads=n_threads, **settings)
            ions = recorded_ions(run, instrument, perturbation, number)
        else:
            ions = operators.emulate(number, instrument.efficiency, **values_of(variant, chosen, operators.axes))
        return test.of(variant, ions)

    # twins of the feature, and of sizes with equal probabilities per relative change
    drawn = np.exp(random.uniform(math.log(low), math.log(high), twins)) if low < high else np.empty(0)
    nominal = [twin(seed + 1000 + k, size) for k in range(twins)]
    sized = [twin(seed + 1000 + twins + k, value) for k, value in enumerate(drawn)]
    p_values = np.array([one.p_value for one in nominal])
    of_sizes = test.sized(drawn, sized) if sized else None
    measured, true = _columns(nominal)
    return Visibility(size, significance, p_values, measured, true, of_sizes, operators)


def is_simulated_in_full(feature: Phase) -> bool:
    """Whether the twins of a feature are full simulations by default: one with an order, or without a size."""
    return feature.order is not None or not math.isfinite(size_of(feature))


def check_permutations(permutations: int, significance: float) -> None:
    """Check that a feature can be found: the smallest p-value of so many permutations is significant."""
    check_count(permutations, "permutations", at_least=1)
    check_number(significance, "significance", above=0, below=1)
    needed = math.ceil(1 / significance - 1 - 1e-9)
    if permutations < needed:
        raise ValueError(
            f"permutations must be at least 1 / significance - 1 = {needed:,}, got {permutations}: no p-value could be "
            f"as small as the significance {significance:g}"
        )


def permutation_p_value(
    analysis: Callable[[Floats, NDArray[np.int64]], Any],
    positions: ArrayLike,
    labels: ArrayLike,
    *,
    permutations: int = 99,
    exceedances: int | None = None,
    seed: int | np.random.Generator = 0,
) -> float:
    """p-value of an analysis, by permuting the labels among the same positions.

    Parameters
    ----------
    positions : array_like
        Positions [nm], shape (n, 3).
    labels : array_like of int
        Labels, shape (n,).

    Examples
    --------
    >>> places = np.random.default_rng(1).random((500, 3))
    >>> def analysis(positions, labels):
    ...     return positions[labels == 1, 0].mean()
    >>> from apt_evap.studies.visibility.probability import permutation_p_value
    >>> permutation_p_value(analysis, places, (places[:, 0] > 0.5).astype(int))
    0.01
    """
    places = check_array(positions, "positions", ("n", 3))
    kinds = check_array(labels, "labels", (len(places),), dtype=np.int64)
    random = np.random.default_rng(seed)
    check_count(permutations, "permutations", at_least=1)
    observed = _results(analysis, places, kinds)["statistic"]
    k = 0
    for m in range(1, permutations + 1):
        k += _results(analysis, places, random.permutation(kinds))["statistic"] >= observed
        if exceedances is not None and k >= exceedances:
            return k / m
    return (k + 1) / (permutations + 1)


class _Analysed(NamedTuple):
    p_value: float
    ions: int
    measured: dict[str, float]
    true: dict[str, float]


@dataclass(frozen=True)
class _Test:
    """An analysis and its p-value, with the arguments of `estimate_visibility`."""

    analysis: Callable[[Floats, NDArray[np.int64]], Any]
    reach: float | None
    permutations: int
    significance: float
    random: np.random.Generator

    def of(self, feature: Phase, ions: Ions) -> _Analysed:
        """What the analysis finds in the ions of a twin."""
        solute = _solute(ions)
        shape, true = apparent_shape(feature, ions, solute)
        measured = {f"apparent {name}": value for name, value in shape.items()}
        positions, labels = ions.positions, ions.labels
        if self.reach is not None and hasattr(feature.region, "distance"):
            near = feature.region.distance(positions) <= self.reach
            positions, labels = positions[near], labels[near]
        results = _results(self.analysis, positions, labels)
        measured |= {name: value for name, value in results.items() if name != "statistic"}
        enough = max(1, math.floor(self.significance * (self.permutations + 1)) + 1)
        p = permutation_p_value(
            self.analysis, positions, labels, permutations=self.permutations, exceedances=enough, seed=self.random
        )
        plain = {name: name.removeprefix("apparent ") for name in measured}
        known = {name: true[quantity] for name, quantity in plain.items() if quantity in true}
        return _Analysed(p, int(ions.inside.sum()), measured, known)

    def sized(self, sizes: Floats, twins: list[_Analysed]) -> SizedTwins:
        """Twins with different sizes."""
        is_found = np.array([twin.p_value <= self.significance for twin in twins])
        return SizedTwins(sizes, np.array([twin.ions for twin in twins]), is_found, _columns(twins)[0])


def apparent_shape(feature: Phase, ions: Ions, solute: int) -> tuple[dict[str, float], dict[str, float]]:
    """Shape and composition of an analysis with the true ions of a feature, and the true values.

    Of a sphere the semi-axes of the ellipsoid with the second moments of its ions, of a layer the thickness of one with
    the second moment along the normal, and the composition of all ions within.
    """
    nan = math.nan
    true = dict.fromkeys(_SIZES, size_of(feature))
    true["composition"] = float(np.mean(ions.labels[ions.inside] == solute)) if ions.inside.any() else nan
    enough = np.count_nonzero(ions.inside) >= _FEWEST
    match feature.region:
        case Sphere():
            if not enough:
                return {"lateral": nan, "depth": nan, "composition": nan}, true
            within, axes = ellipsoid_of(ions.positions, ions.inside)
            seen = {"lateral": axes.lateral, "depth": axes.depth}
        case Layer(normal=normal):
            along = ions.positions @ (np.array(normal) / np.linalg.norm(normal))
            mean = along[ions.inside].mean() if enough else nan
            thickness = math.sqrt(12) * along[ions.inside].std() if enough else nan
            within, seen = np.abs(along - mean) <= thickness / 2, {"thickness": float(thickness)}
        case _:
            return {}, true
    return seen | {"composition": float(np.mean(ions.labels[within] == solute)) if within.any() else nan}, true


def _solute(ions):
    """Label of the element that is most enriched in the feature."""
    if not ions.inside.any() or ions.inside.all():
        return int(ions.labels.max(initial=0))
    n = int(ions.labels.max()) + 1
    inside, outside = (np.bincount(ions.labels[part], minlength=n) for part in (ions.inside, ~ions.inside))
    return int(np.argmax(inside / inside.sum() - outside / outside.sum()))


def _columns(twins):
    """Measured and true values of all twins."""
    return tuple(
        {name: np.array([getattr(one, part).get(name, math.nan) for one in twins]) for name in names}
        for part in ("measured", "true")
        for names in [dict.fromkeys(name for one in twins for name in getattr(one, part))]
    )


def _results(analysis, positions, labels):
    """Numbers by name that an analysis returns; ValueError without a statistic that can be compared, such as NaN."""
    returned = analysis(positions, labels)
    results = returned if isinstance(returned, Mapping) else {"statistic": returned}
    name = getattr(analysis, "__qualname__", type(analysis).__name__)
    try:
        numbers = {key: float(value) for key, value in results.items()}
    except (TypeError, ValueError):
        numbers = {}
    if math.isnan(numbers.get("statistic", math.nan)):
        raise ValueError(
            f'analysis {name} must return a number, or numbers by name with a "statistic", got {short_text(returned)} '
            f"for {len(positions):,} ions"
        )
    return numbers


def _threshold(ions, is_found, probability):
    """Number of ions where a logistic function of its logarithm has a value; NaN outside the given numbers."""
    x = np.log(np.maximum(ions, 1))
    if len(np.unique(is_found)) < 2:
        return math.nan
    centre, sign = x.mean(), 2.0 * is_found - 1

    def loss(constants):
        return np.logaddexp(0, -sign * (constants[0] + constants[1] * (x - centre))).sum() + _WEAK * constants[1] ** 2

    offset, slope = scipy.optimize.minimize(loss, [0.0, 1.0]).x
    if slope <= 0:
        return math.nan
    value = centre + (math.log(probability / (1 - probability)) - offset) / slope
    return math.exp(value) if x.min() <= value <= x.max() else math.nan
