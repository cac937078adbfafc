"""Fit of the time zero and the flight length of an instrument to the peaks of a spectrum."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from apt_evap._common.types import Floats
from apt_evap.detection.hits import Hits
from apt_evap.spectra.isotope_comb import Comb, LogSpectrum, in_intervals

_SHAPE = 0.25  # of the width of a peak, by which its unknown shape may shift it
_DRIFT = 3e-4  # of m/n, by which a measured voltage may shift it
_GROUPS, _PER_GROUP = 6, 100  # groups of ions of different voltages in a peak, and their least number of ions
_FEWEST = 50  # ions of a peak
_BROADEST = 0.01  # error of the time zero over the shortest time of flight: a larger one says nothing
_VARIED = 0.02  # standard deviation of the voltage over its mean, from which it shows the time zero
_SAMPLE = 50_000  # ions of a spectrum whose sharpness is measured
_LATEST, _TIMES = 0.08, 81  # largest time zero over the median time of flight that is tried; number of times
_FAR = 3.0  # errors of the length
_SHARPER = 1.1  # sharpness over that at the start


@dataclass(frozen=True)
class FlightFit:
    """Time zero and flight length that put the peaks of a spectrum in their places.

    m/n = 2 e V (t - t0)^2 / L^2 with the flight length L^2 = distance^2 + x^2 + y^2, see `mass_to_charge`.

    Parameters
    ----------
    distance : float
        Distance from the apex to the detector [mm].
    time_zero : float
        Time that is subtracted from the times of flight [ns].
    distance_error, time_zero_error : float
        Standard errors [mm], [ns]; infinite without a peak, and that of a time that was not fitted.
    peaks : tuple of str
        Names of the peaks of the fit.
    nominal : float
        Distance that was given [mm]; NaN if it is not known.
    """

    distance: float
    time_zero: float
    distance_error: float = math.inf
    time_zero_error: float = math.inf
    peaks: tuple[str, ...] = ()
    nominal: float = math.nan

    def __str__(self) -> str:
        distance, time = f"flight length {self.distance:.2f}", f"t0 = {self.time_zero:.4g}"
        if not self.peaks:
            return f"m/n with {distance} mm and {time} ns, not fitted"
        fitted = f"m/n with {distance} ± {self.distance_error:.2g} mm"
        if math.isfinite(self.time_zero_error):
            text = f"{fitted} and t0 = {self.time_zero:.1f} ± {self.time_zero_error:.1g} ns, fitted to {self._names}"
        else:
            alone = "alone cannot" if len(self.peaks) == 1 else "cannot"
            text = f"{fitted} and {time} ns: {self._names} {alone} separate a time from a length, so only this is "
            text += "fitted"
        apart = self.distance - self.nominal
        if not abs(apart) > _FAR * self.distance_error:
            return text
        voltage = (self.nominal / self.distance) ** 2 - 1
        change = f"about {abs(voltage):.0%} {'more' if voltage > 0 else 'less'} would do the same"
        time = "" if math.isfinite(self.time_zero_error) else "the time zero, "
        return (
            f"{text}; this is {abs(apart):.2f} mm, {abs(apart) / self.distance_error:.0f} of its errors, "
            f"{'above' if apart > 0 else 'below'} the {self.nominal:g} mm that were given: check that length, "
            f"{time}the voltages ({change}) and the names of the peaks"
        )

    @property
    def _names(self):
        return " and ".join(filter(None, [", ".join(self.peaks[:-1]), self.peaks[-1]]))

    def masses(self, hits: Hits) -> Floats:
        """m/n of ions [Da], shape (n,)."""
        (masses,) = hits.with_masses(self.distance, self.time_zero).require("mass_to_charge")
        return masses

    def improved(self, hits: Hits, combs: Sequence[Comb]) -> "FlightFit":
        """The fit after a step of Newton's method.

        Parameters
        ----------
        hits : Hits
            The ions.
        combs : sequence of Comb
            Ions of the spectrum that this fit gives.
        """
        masses, groups, names, widths = self.masses(hits), [], [], []
        time, x, y = (np.asarray(values, np.float64) for values in hits.require("time_of_flight", "x", "y"))
        of_time = 2.0 / (time - self.time_zero)  # relative change of m/n by a time, and by a length
        of_length = 2.0 * self.distance / (self.distance**2 + x * x + y * y)
        voltage = hits.total_voltage
        for comb in combs:
            rows = np.flatnonzero(in_intervals(masses, comb.intervals))
            if len(rows) < _FEWEST:
                continue
            place = np.log(masses[rows])
            spread, middle = float(place.std()), float(place.mean())
            for part in np.array_split(rows[np.argsort(voltage[rows])], min(_GROUPS, len(rows) // _PER_GROUP) or 1):
                shift = math.log(comb.factor) + float(np.log(masses[part]).mean()) - middle
                error = math.hypot(spread / math.sqrt(len(part)), _DRIFT)
                groups.append((shift, of_time[part].mean(), of_length[part].mean(), error, len(names)))
            names.append(comb.name)
            widths.append(comb.width * _SHAPE)
        if not names:
            return self
        shift, of_time, of_length, error, number = np.array(groups).T
        # the shape of a peak, which is not known, shifts all its groups alike: an unknown of its own, about zero
        of_peak = (number[:, None] == np.arange(len(names))).astype(float)
        design = np.column_stack([of_length, of_peak, of_time]) / error[:, None]
        design = np.vstack(
            [design, np.column_stack([np.zeros(len(names)), np.diag(1 / np.array(widths)), np.zeros(len(names))])]
        )
        target = np.append(shift / error, np.zeros(len(names)))
        for unknowns in (design.shape[1], design.shape[1] - 1):  # first with the time, then without
            with_time = unknowns == design.shape[1]
            try:
                covariance = np.linalg.inv(design[:, :unknowns].T @ design[:, :unknowns])
            except np.linalg.LinAlgError:
                if with_time:
                    continue
                return self
            step = covariance @ design[:, :unknowns].T @ target
            with np.errstate(invalid="ignore"):  # a variance below 0, by rounding, is that of a time that is not known
                errors = np.sqrt(np.diag(covariance))
            if not with_time or errors[-1] * of_time.max() / 2 < _BROADEST:
                break
        return FlightFit(
            self.distance + float(step[0]),
            self.time_zero + (float(step[-1]) if with_time else 0.0),
            float(errors[0]),
            float(errors[-1]) if with_time else math.inf,
            tuple(names),
        )

    def sharpened(self, hits: Hits) -> "FlightFit":
        """The fit with the time zero whose spectrum is sharpest, if the voltages vary enough to see it."""
        from scipy.ndimage import uniform_filter1d

        voltage = hits.total_voltage
        if not len(hits) or np.std(voltage) < _VARIED * np.mean(voltage):
            return self
        time = np.asarray(hits.require("time_of_flight")[0], np.float64)
        sample = hits[:: max(1, len(hits) // _SAMPLE)]
        longest = _LATEST * float(np.median(time))
        scores = {}
        for shift in np.linspace(-longest, longest, _TIMES).tolist():
            fit = replace(self, time_zero=self.time_zero + shift)
            counts = LogSpectrum(fit.masses(sample)).counts
            # the sum of squares, of bins of about the width of a peak
            scores[shift] = float(np.square(uniform_filter1d(counts, 3)).sum() / max(counts.sum(), 1.0) ** 2)
        best = max(scores, key=lambda shift: scores[shift])
        if scores[best] < _SHARPER * scores[min(scores, key=abs)]:
            return self
        return replace(self, time_zero=self.time_zero + best)
