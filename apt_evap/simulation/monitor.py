"""The monitor of a run: convergence of the charges, and fractions of ions with problems."""

from collections.abc import Sequence
from typing import Any

import numpy as np

from apt_evap._common.codec import count, number, settings
from apt_evap._common.types import Floats
from apt_evap.detection.hits import Outcome
from apt_evap.evaporation.emitter import Emitter
from apt_evap.simulation.history import History
from apt_evap.simulation.run import Run
from apt_evap.warnings import ChargesWarning, ResponseWarning, RunWarning, warn


@settings
class Monitor:
    """Monitoring of a run; it does not change the results."""

    interval: int | None = count(
        "Ions between two checks, by default those of ten relaxations. A check comes just before a relaxation, when "
        "the errors of the charges are largest.",
        default=None,
        at_least=1,
    )
    sample: int = count("Surface atoms whose charges are checked by direct sums.", default=128, at_least=1)
    charge_bound: float = number(
        "RMS residual of the charges, relative to the mean charge, above which a warning is given. Measured on Ni[111] "
        "with the default settings (R = 20 a and 40 a, 4,000 events): 0.0005 to 0.0032. The RMS deviation from "
        "converged charges was 0.8 to 2.5 times the residual.",
        default=0.01,
        above=0,
    )
    fraction_bound: float = number(
        "Fraction of the ions between two checks that never left, or that have inexact responses, above which a "
        "warning is given; in the same runs there were none.",
        default=0.01,
        at_least=0,
        at_most=1,
    )


def charge_residuals(emitter: Emitter, sample: int, seed: int) -> Floats:
    """Residuals of the equation of the charging rule for sampled charges, by direct sums.

    Returns
    -------
    ndarray, shape (sample,)
        Residuals relative to the mean charge of the surface; NaN for a rule that does not define them.
    """
    selection = np.flatnonzero(emitter.tip.evaporable[emitter.atoms])
    if len(selection) > sample:
        selection = np.sort(np.random.default_rng(seed).choice(selection, sample, replace=False))
    return emitter.charge_residuals(selection)


class MonitorState:
    """Checks the charges of a run at intervals, and counts its ions.

    Parameters
    ----------
    settings : Monitor
        Interval of the checks, and bounds of the warnings.
    interval : int
        Ions between two checks.
    first : int
        Number of the first ion.
    previous : sequence of Run
        Existing parts of the run.
    """

    def __init__(self, settings: Monitor, interval: int, first: int = 0, previous: Sequence[Run] = ()) -> None:
        self._settings, self._interval = settings, interval
        self._rows = []  # complete checks that have not been taken yet
        self._open = None  # ions, RMS and largest residual of a check whose ions are not all counted
        self._since = []  # outcomes, flags and fields of ions since the last check, batch by batch
        self._counted, self._warned = first, set()
        self._last = max((int(part.history.ions[-1]) for part in previous if len(part.history.ions)), default=first)
        self._latest = {}
        for part in previous:
            self.count(part)

    def due(self, ions: int) -> bool:
        """Whether a check is due after this number of ions."""
        return ions - self._last >= self._interval

    def look(self, emitter: Emitter, ions: int) -> None:
        """Check the charges; the fractions follow when all ions up to this number are counted."""
        residuals = charge_residuals(emitter, self._settings.sample, seed=ions)
        rms, largest = float(np.sqrt(np.mean(residuals**2))), float(np.abs(residuals).max())
        self._last, self._open = ions, (ions, rms, largest)
        self._latest["charges"] = f"{rms:.1e}"
        if rms > self._settings.charge_bound:
            self._warn(
                ChargesWarning,
                "charges",
                f"after {ions:,} ions the RMS residual of {len(residuals)} charges is {rms:.2g} of the mean charge, "
                f"above the bound of {self._settings.charge_bound:g}",
                "use a smaller sweep_interval or tolerance, or a larger patch_radius (ChargeSettings, or [charges] in "
                "a settings file)",
            )
        self._close()

    def count(self, part: Run) -> None:
        """Count the ions of the next part of the run."""
        if len(part):
            new = part.emissions.ions >= self._last if self._open is None else slice(None)
            hits = part.hits(part.first_perturbation)
            self._since.append((hits.outcome[new], part.flagged[new], part.not_flown[new], part.fields[new]))
            self._counted = int(part.emissions.ions[-1]) + 1
        self._close()

    def _close(self):
        if self._open is None or self._counted < self._open[0]:
            return
        if self._since:
            outcome, flagged, not_flown, fields = (
                np.concatenate(columns) for columns in zip(*self._since, strict=True)
            )
            events = (outcome == Outcome.MISSED, outcome == Outcome.NEVER_LEFT, flagged)
            n_flown = max(1, np.count_nonzero(~not_flown))
            fractions = [float(np.count_nonzero(event) / n_flown) for event in events]
            self._rows.append((*self._open, *fractions, float(np.mean(fields))))
            self._compare_with_bounds(*fractions)
        self._open, self._since = None, []

    def _compare_with_bounds(self, missed, never_left, flagged):
        self._latest |= {"missed": f"{missed:.1%}", "never left": f"{never_left:.1%}", "flagged": f"{flagged:.1%}"}
        for fraction, kind, what, advice in (
            (
                never_left,
                RunWarning,
                "never left the specimen",
                "a larger max_steps (FlightSettings, or [flights] in a settings file) may help",
            ),
            (
                flagged,
                ResponseWarning,
                "have inexact responses",
                "use a smaller energy_limit (ResponseSettings, or [responses] in a settings file)",
            ),
        ):
            if fraction > self._settings.fraction_bound:
                self._warn(
                    kind,
                    what,
                    f"{fraction:.1%} of the last ions, up to number {self._last:,}, {what} (bound "
                    f"{self._settings.fraction_bound:.2g})",
                    advice,
                )

    def _warn(self, kind, what, message, advice):
        if what not in self._warned:  # once per run, not at every check
            self._warned.add(what)
            warn(message, kind, advice)

    def pop_history(self) -> History:
        """Return and clear the history of the checks since the last call."""
        rows, self._rows = self._rows, []
        columns = list(zip(*rows, strict=True)) or History.empty()
        return History(np.array(columns[0], np.int64), *(np.array(column, float) for column in columns[1:]))

    @property
    def latest(self) -> dict[str, Any]:
        """Results of the latest check for the progress line, dict."""
        return dict(self._latest)
