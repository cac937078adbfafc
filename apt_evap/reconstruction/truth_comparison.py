"""The same measure of all sites, of the detected ions at their true sites, and of their reconstruction."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import scipy

from apt_evap._common.codec import ForJson
from apt_evap._common.types import Estimated
from apt_evap._common.validation import check_choice, check_kind, check_number, check_sequence, short_text
from apt_evap.detection.instrument import Instrument
from apt_evap.emission.perturbations import Perturbation
from apt_evap.measures.point_cloud import PointCloud
from apt_evap.reconstruction.constants import run_constants
from apt_evap.reconstruction.reconstruct import reconstruct
from apt_evap.simulation.run import Run

PLACED = ("shift", "rotation", "depth_scale")
"""Free constants that place a reconstruction on the true sites."""

_FEWEST = 4  # simulations of a correction: a line has two constants


@dataclass(frozen=True)
class TruthComparison(ForJson):
    """Values of measures, each of several point clouds of one run.

    Parameters
    ----------
    ions : dict of str to int
        Number of ions of each point cloud: "all sites", "detected" (at their true sites), and each reconstruction.
    values : dict of str to dict
        Values of each measure by the name of the point cloud, as `Estimated`; the error is NaN if the measure has none.
    """

    ions: Mapping[str, int]
    values: Mapping[str, Mapping[str, Estimated]]

    @property
    def reconstructions(self) -> tuple[str, ...]:
        """Names of the reconstructions."""
        return tuple(self.ions)[2:]

    def loss_to_detection(self, measure: str) -> float:
        """Value of the detected ions at their true sites less that of all sites."""
        row = self._row(measure)
        return row["detected"].value - row["all sites"].value

    def loss_to_trajectories(self, measure: str, reconstruction: str = "cap") -> float:
        """Value of a reconstruction less that of the same ions at their true sites."""
        row = self._row(measure)
        return row[check_choice(reconstruction, "reconstruction", self.reconstructions)].value - row["detected"].value

    def _row(self, measure):
        return self.values[check_choice(measure, "measure", self.values)]

    def table(self) -> str:
        """The values as lines of text, with one column for each point cloud.

        Returns
        -------
        str
        """
        rows = [["", *self.ions], ["ions", *(f"{number:,}" for number in self.ions.values())]]
        rows += [[name, *(_text(row[cloud]) for cloud in self.ions)] for name, row in self.values.items()]
        widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
        lines = ("  ".join(text.ljust(width) for text, width in zip(row, widths, strict=True)) for row in rows)
        return "\n".join(line.rstrip() for line in lines)

    def __repr__(self) -> str:
        return f"<TruthComparison of {', '.join(self.values)}: {', '.join(self.ions)}>"

    @classmethod
    def from_dict(cls, content: Mapping[str, Any]) -> TruthComparison:
        """Make a comparison from the results that `to_dict` returned, such as for `corrected`.

        Parameters
        ----------
        content : mapping
            Other entries are left out.

        Returns
        -------
        TruthComparison

        Raises
        ------
        ValueError
            If the content is another one.
        """
        try:
            values = {
                name: {
                    cloud: Estimated(*(_number(pair[part]) for part in Estimated._fields))
                    for cloud, pair in row.items()
                }
                for name, row in content["values"].items()
            }
            return cls(dict(content["ions"]), values)
        except (AttributeError, KeyError, TypeError, ValueError) as error:
            raise ValueError(f"content must be the result of to_dict, got {short_text(content)}") from error


def _number(value):
    """A number of JSON; NaN for None."""
    return math.nan if value is None else float(value)


def compare_with_truth(
    run: Run,
    measure: Callable[[PointCloud], Mapping[str, Any]],
    instrument: Instrument | None = None,
    perturbation: Perturbation | None = None,
    *,
    reconstructions: Mapping[str, Mapping[str, Any]] | None = None,
    region: Any = None,
    fit: Sequence[str] = PLACED,
    seed: int = 0,
) -> TruthComparison:
    """Measure all sites of a run, its detected ions at their true sites, and their reconstructions.

    Parameters
    ----------
    run : Run
        A run of a crystalline specimen with responses or flights.
    measure : callable
        Takes a `measures.PointCloud` in the coordinates of the specimen, and returns numbers by name, each a number or
        a pair of a number and its error.
    instrument : Instrument, optional
        The instrument; by default the detector of the run, which detects all ions.
    perturbation : perturbation, optional
        Initial conditions of the ions; by default the first one flown.
    reconstructions : mapping, optional
        Arguments of `reconstruct` by the name of each reconstruction, such as ``{"cap": {}, "evolving": {"shape":
        "evolving", "solutes": ["Cu"]}}``; the constants are those of the run and of the instrument. By default
        ``{"cap": {}}``.
    region : region, optional
        Only ions in this region are measured. By default all detected ions, and all sites within the convex hull of
        theirs.
    fit : sequence of str
        Free constants that place each reconstruction on the sites, as for `Reconstruction.errors`.
    seed : int
        Seed of the random numbers of the instrument.

    Returns
    -------
    TruthComparison

    Raises
    ------
    ValueError
        If a reconstruction is called "all sites" or "detected", or the measure returns other names for another cloud.

    Examples
    --------
    >>> tip = ae.Tip("Ni", apex_radius=2.5, axis=(1, 1, 1), solutes={"Al": 0.1}, seed=1)
    >>> run = ae.Simulation(tip, seed=1).run(400, [ae.Unperturbed()], responses=False)
    >>> compared = ae.reconstruction.compare_with_truth(run, lambda cloud: {"Al": cloud.fractions()["Al"]})
    >>> list(compared.ions)
    ['all sites', 'detected', 'cap']
    >>> compared.loss_to_trajectories("Al")  # the same ions
    0.0
    """
    real = check_kind(run, "run", Run, "a Run").in_real_units()
    if not callable(measure):
        raise ValueError(f"measure must be a function of a point cloud, got {measure!r:.80}")
    protocols = {"cap": {}} if reconstructions is None else dict(reconstructions)
    if not protocols or {"all sites", "detected"} & set(protocols):
        raise ValueError(
            f"reconstructions must have names other than 'all sites' and 'detected', got {list(protocols)}"
        )
    perturbation = run.first_perturbation if perturbation is None else perturbation
    constants = run_constants(real)
    if instrument is None:
        hits = real.hits(perturbation)
    else:
        hits = real.record(instrument, perturbation, seed=seed)
        constants |= {"distance": instrument.distance, "efficiency": instrument.efficiency}
        constants["detector_radius"] = instrument.field_of_view / 2
    volumes = {name: reconstruct(hits, **(constants | dict(options))) for name, options in protocols.items()}
    # in the field of view that all reconstructions have
    detected = PointCloud.of(next(iter(volumes.values())).hits)
    clouds = {"all sites": run.sites(), "detected": detected}
    clouds |= {
        name: PointCloud.of(volume.hits, positions=volume.fitted_positions(fit=fit)) for name, volume in volumes.items()
    }
    if region is None:
        clouds["all sites"] = clouds["all sites"].select(detected.hull)
    else:
        clouds = {name: cloud.select(region) for name, cloud in clouds.items()}
    values: dict[str, dict[str, Estimated]] = {}
    for number, (name, cloud) in enumerate(clouds.items()):
        row = check_kind(measure(cloud), "result of measure", Mapping, "a mapping of names to numbers")
        if number and set(row) != set(values):
            raise ValueError(f"measure must return {', '.join(values)} for all point clouds, got {', '.join(row)}")
        for key, value in row.items():
            values.setdefault(key, {})[name] = (
                Estimated(*value) if np.ndim(value) else Estimated(float(value), math.nan)
            )
    return TruthComparison({name: len(cloud) for name, cloud in clouds.items()}, values)


def corrected(
    comparisons: Sequence[TruthComparison], measure: str, value: float, reconstruction: str = "cap"
) -> Estimated:
    r"""True value of a measure for a measured one, by simulations of specimens of the same kind.

    Parameters
    ----------
    comparisons : sequence of TruthComparison
        At least four, such as those of a sweep over the size of a precipitate.
    measure : str
        Name of the measure.
    value : float
        What the reconstruction of the measurement shows.
    reconstruction : str
        The reconstruction that was used.

    Returns
    -------
    Estimated
        True value, and half of an interval that contains it with 68 %: the error of a prediction.

    Raises
    ------
    ValueError
        If there are fewer than four simulations with this measure, or the value is outside those that they show.

    Notes
    -----
    The true value, that of all sites, is a line through those of the simulations as a function of the reconstructed
    value, by least squares. The error is the scatter about the line, with that of the line, times the factor of
    Student's distribution with n - 2 degrees of freedom.
    """
    rows = [
        check_kind(one, "comparisons", TruthComparison, "results of compare_with_truth")._row(measure)
        for one in check_sequence(comparisons, "comparisons", "TruthComparison")
    ]
    if len(rows) < _FEWEST:
        raise ValueError(f"comparisons must be at least {_FEWEST}, got {len(rows)}")
    check_choice(reconstruction, "reconstruction", comparisons[0].reconstructions)
    seen, true = (np.array([row[name].value for row in rows]) for name in (reconstruction, "all sites"))
    known = np.isfinite(seen) & np.isfinite(true)
    if np.count_nonzero(known) < _FEWEST or np.ptp(seen[known]) == 0:
        raise ValueError(
            f"comparisons must have at least {_FEWEST} different values of {measure}, got {np.unique(seen[known]).size}"
        )
    seen, true = seen[known], true[known]
    value = check_number(value, "value", at_least=seen.min(), at_most=seen.max(), why="what the simulations show")
    slope, start = np.polyfit(seen - seen.mean(), true, 1)
    n = len(seen)
    scatter = math.sqrt(float(((true - start - slope * (seen - seen.mean())) ** 2).sum()) / (n - 2))
    away = value - seen.mean()
    spread = math.sqrt(1 + 1 / n + away**2 / float(((seen - seen.mean()) ** 2).sum()))
    factor = float(scipy.stats.t.ppf(scipy.stats.norm.cdf(1.0), n - 2))
    return Estimated(float(start + slope * away), factor * scatter * spread)


def _text(estimated):
    """Number and error with the digits that the error leaves."""
    value, error = estimated
    return f"{value:.4g}" if not np.isfinite(error) else f"{value:.3g} ± {error:.1g}"
