"""The monitor of a run: how well its charges have converged, and the fractions of ions that went badly."""

import warnings
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from apt_evap._common.types import Floats
from apt_evap._common.validation import check_count, check_number
from apt_evap._common.warnings import ChargesWarning, ResponseWarning, RunWarning
from apt_evap.detection.hits import Outcome
from apt_evap.evaporation.emitter import Emitter
from apt_evap.simulation.history import History

if TYPE_CHECKING:
    from apt_evap.simulation.run import Run


@dataclass(frozen=True)
class WatchSettings:
    """How a run is watched; it changes no result.

    Parameters
    ----------
    interval : int, optional
        Ions between two looks, which come just before relaxations, when charges are worst; by default ten relaxations.
    sample : int
        Surface atoms whose charges are checked by direct sums.
    charge_bound : float
        RMS residual of the charges, relative to the mean charge, above which a warning says so. Measured on Ni[111]
        with the default settings: 0.0005 to 0.0032 (R = 20 a and 40 a, 4,000 events), with RMS errors of the charges,
        against converged ones, of 0.8 to 2.5 times as much.
    fraction_bound : float
        Fraction of the ions between two looks that never leave, or whose responses are inexact, above which a warning
        says so; in the same runs there were none.
    """

    interval: int | None = None
    sample: int = 128
    charge_bound: float = 0.01
    fraction_bound: float = 0.01

    def __post_init__(self):
        if self.interval is not None:
            check_count(self.interval, "interval", at_least=1)
        check_count(self.sample, "sample", at_least=1)
        check_number(self.charge_bound, "charge_bound", above=0)
        check_number(self.fraction_bound, "fraction_bound", at_least=0, at_most=1)


def charge_residuals(emitter: Emitter, sample: int, seed: int) -> Floats:
    """How far sampled charges are from the equation of the charging rule, by direct sums.

    Parameters
    ----------
    emitter : Emitter
        The charged surface.
    sample : int
        Surface atoms that may leave, drawn at random; all of them if there are not more.
    seed : int
        Seed of the draw.

    Returns
    -------
    ndarray, shape (sample,)
        Residuals over the mean charge of the surface; NaN for a rule that cannot say.
    """
    chosen = np.flatnonzero(emitter.tip.evaporable[emitter.atoms])
    if len(chosen) > sample:
        chosen = np.sort(np.random.default_rng(seed).choice(chosen, sample, replace=False))
    return emitter.charge_residuals(chosen)


class Monitor:
    """Looks at a run as it goes on.

    Parameters
    ----------
    settings : WatchSettings
        When to look, and what to warn of.
    interval : int
        Ions between two looks.
    first : int
        Number of the first ion.
    done : sequence of Run
        Parts of the run that are there already.
    """

    def __init__(self, settings: WatchSettings, interval: int, first: int = 0, done: "Sequence[Run]" = ()) -> None:
        self._settings, self._interval = settings, interval
        self._rows = []  # looks whose ions have all been counted, not taken yet
        self._open = None  # ions, RMS and largest residual of a look whose ions are still flying
        self._since = []  # outcomes, marks and fields of the ions since the last look, batch by batch
        self._counted, self._warned = first, set()
        self._last = max((int(part.history.ions[-1]) for part in done if len(part.history.ions)), default=first)
        self._latest = {}
        for part in done:
            self.count(part)

    def due(self, ions: int) -> bool:
        """Whether it is time for a look after so many ions."""
        return ions - self._last >= self._interval

    def look(self, emitter: Emitter, ions: int) -> None:
        """Check the charges; the fractions follow once all of these ions have been counted."""
        residuals = charge_residuals(emitter, self._settings.sample, seed=ions)
        rms, largest = float(np.sqrt(np.mean(residuals**2))), float(np.abs(residuals).max())
        self._last, self._open = ions, (ions, rms, largest)
        self._latest["charges"] = f"{rms:.1e}"
        if rms > self._settings.charge_bound:
            self._warn(
                ChargesWarning,
                "charges",
                f"after {ions:,} ions the residuals of the charges are {rms:.2g} of the mean charge (RMS of "
                f"{len(residuals)}), above the bound of {self._settings.charge_bound:g}: take a smaller sweep_interval "
                "or tolerance, or a larger patch_radius, of ChargeSettings, [charges] in a file",
            )
        self._close()

    def count(self, part: "Run") -> None:
        """Count the ions of the next part of the run."""
        if len(part):
            known = part.emissions.ions >= self._last if self._open is None else slice(None)
            hits = part.hits(part.first_perturbation)
            self._since.append((hits.outcome[known], part.flagged[known], part.fields[known]))
            self._counted = int(part.emissions.ions[-1]) + 1
        self._close()

    def _close(self):
        if self._open is None or self._counted < self._open[0]:
            return
        if self._since:
            outcome, flagged, fields = (np.concatenate(columns) for columns in zip(*self._since, strict=True))
            fractions = [float(np.mean(outcome == kind)) for kind in (Outcome.MISSED, Outcome.NEVER_LEFT)]
            fractions.append(float(np.mean(flagged)))
            self._rows.append((*self._open, *fractions, float(np.mean(fields))))
            self._judge(*fractions)
        self._open, self._since = None, []

    def _judge(self, missed, never_left, flagged):
        self._latest |= {"missed": f"{missed:.1%}", "never left": f"{never_left:.1%}", "flagged": f"{flagged:.1%}"}
        for fraction, kind, what, advice in (
            (
                never_left,
                RunWarning,
                "never left the specimen",
                "more max_steps of FlightSettings, [flights] in a file, may help",
            ),
            (
                flagged,
                ResponseWarning,
                "have inexact responses",
                "a smaller energy_limit of ResponseSettings, [responses] in a file, helps",
            ),
        ):
            if fraction > self._settings.fraction_bound:
                self._warn(
                    kind,
                    what,
                    f"{fraction:.1%} of the last ions, up to {self._last:,}, {what}, expected at most "
                    f"{self._settings.fraction_bound:.2g}: {advice}",
                )

    def _warn(self, kind, what, message):
        if what not in self._warned:  # once in a run, not at every look
            self._warned.add(what)
            warnings.warn(message, kind, stacklevel=6)

    def take(self) -> History:
        """History of the looks since it was last taken."""
        rows, self._rows = self._rows, []
        columns = list(zip(*rows, strict=True)) or History.empty()
        return History(np.array(columns[0], np.int64), *(np.array(column, float) for column in columns[1:]))

    @property
    def latest(self) -> dict[str, Any]:
        """What the progress line shows of the latest look, dict."""
        return dict(self._latest)
