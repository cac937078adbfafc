"""Numbers of the ions that are chosen, by the likelihood of the whole spectrum, with those in flanks of others."""

from collections.abc import Mapping, Sequence

import numpy as np

from apt_evap._common.types import Floats
from apt_evap.spectra.flank_ions import Flank, FlankFit, Lines
from apt_evap.spectra.ion_fit import IonFit
from apt_evap.spectra.ion_names import Abundances, Ion
from apt_evap.spectra.ion_profiles import IonProfiles
from apt_evap.spectra.mass_calibration import MassCalibration
from apt_evap.spectra.peak_contents import PeakContents

_SHAPE = 0.003  # relative error of the number of an ion by the shape of its peaks


class IonNumbers:
    """Numbers of ions with their covariance.

    Parameters
    ----------
    peaks : PeakContents
        The spectrum.
    fit : IonFit
        Its peaks and ions.
    abundances : Abundances
        Isotopes.
    calibration : MassCalibration
        Measured places of ions.

    Attributes
    ----------
    flanks : dict of Ion to Flank
        By the ion in the flank.
    """

    def __init__(self, peaks: PeakContents, fit: IonFit, abundances: Abundances, calibration: MassCalibration) -> None:
        self._peaks, self._fit, self._abundances, self._calibration = peaks, fit, abundances, calibration
        self.flanks: dict[Ion, Flank] = {}
        self._groups: list[tuple[list[Ion], Floats]] = []

    def learn(self, chosen: Sequence[int], groups: Mapping[Ion, Mapping[Ion, float]]) -> None:
        """Fit ions in the flanks of others: by the others, with costs."""
        ions = [self._fit.ions[number] for number in chosen]
        fits = FlankFit(
            self._peaks, self._fit.contents, self._abundances, self._calibration, ions,  # type: ignore[arg-type]
            self._fit.shares[np.asarray(chosen, int)], self._fit.solve(chosen)[0],
        )  # fmt: skip
        for main, costs in groups.items():
            flanks, group, covariance = fits.fit(main, costs)
            self.flanks |= {flank.other: flank for flank in flanks}
            self._groups.append((group, covariance))

    @property
    def named_in_flanks(self) -> set[Ion]:
        """Ions with a name in flanks of others, and these."""
        return {ion for flank in self.flanks.values() if flank.sure for ion in (flank.main, flank.other)}

    def profiles(self, chosen: Sequence[int]) -> IonProfiles:
        """Spectra of some ions: lines that flanks know have places and shapes of their own."""
        ions = [self._fit.ions[number] for number in chosen]
        start, lines = self._fit.solve(chosen)[0], {}
        for other, flank in self.flanks.items():
            if flank.main not in ions:
                continue
            lines[ions.index(flank.main)] = flank.main_lines
            if other in ions:
                lines[ions.index(other)] = flank.lines
                start[ions.index(other)] = max(flank.ions, 1.0)
        return self._profiles(chosen, start, lines)

    def _profiles(self, chosen, start, lines):
        """Spectra of some ions, of which a few have lines of their own."""
        contents, rows = self._fit.contents, self._fit.shares[np.asarray(chosen, int)]
        for at, new in lines.items():
            rows = np.pad(rows, ((0, 0), (0, len(new.mass))))
            rows[at] = 0
            rows[at, -len(new.mass) :] = new.share
            shapes = np.vstack([contents.shapes, np.tile(new.shape, (len(new.mass), 1))])
            contents = contents._replace(mass=np.append(contents.mass, new.mass), shapes=shapes)
        return IonProfiles(self._peaks, contents, rows, start)

    def amounts(self, chosen: Sequence[int]) -> tuple[Floats, Floats]:
        """Ions of each of some ions with their covariance."""
        if not len(chosen):
            return np.zeros(0), np.zeros((0, 0))
        ions, covariance = self.profiles(chosen).amounts_of_all()
        covariance = covariance + np.diag((_SHAPE * ions) ** 2)
        for group, known in self._groups:  # no error is less than with the uncertainty of the tails
            names = [self._fit.ions[number] for number in chosen]
            columns = [at for at, ion in enumerate(group) if ion in names]
            rows = [names.index(group[at]) for at in columns]
            more: Floats = known[np.ix_(columns, columns)] - covariance[np.ix_(rows, rows)]
            size, way = np.linalg.eigh(more)
            covariance[np.ix_(rows, rows)] += way * np.maximum(size, 0) @ way.T
        return ions, covariance

    def with_flank(
        self, ions: Floats, covariance: Floats, chosen: Sequence[int], flank: Flank
    ) -> tuple[Floats, Floats]:
        """Ions of each of some ions and of one in a flank, as many as its error allows, and their covariance."""
        more = max(flank.ions, 0.0) + flank.error
        main = [self._fit.ions[number] for number in chosen].index(flank.main)
        ions = np.append(ions, more)
        ions[main] = max(ions[main] - more, 0.0)
        return ions, np.pad(covariance, (0, 1)) + np.diag([*np.zeros(len(chosen)), more])

    def amounts_with(self, chosen: Sequence[int], number: int) -> tuple[Floats, Floats]:
        """Ions of each of some ions and of one more, whose lines have the common shape at places of their own."""
        ion = self._fit.ions[number]
        masses, shares = self._abundances.lines(ion.formula)  # type: ignore[union-attr]
        lines = Lines(self._calibration.place(masses / ion.charge), shares, self._peaks.shape)  # type: ignore[union-attr]
        start = np.maximum(self._fit.solve([*chosen, number])[0], 1.0)
        ions, covariance = self._profiles([*chosen, number], start, {len(chosen): lines}).amounts_of_all()
        return ions, covariance + np.diag((_SHAPE * ions) ** 2)
