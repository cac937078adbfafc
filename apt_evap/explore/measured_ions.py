"""Measured ions of a file, and the part of them that the maps show, by their masses and their place in the sequence."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

from apt_evap.detection.hits import Hits
from apt_evap.io.formats import read_ranges
from apt_evap.io.measured_file import MeasuredFile
from apt_evap.spectra.mass_spectrum import Spectrum, spectrum


@dataclass(frozen=True)
class IonSelection:
    """Ions that the maps show: what the page changes of a `MeasuredFile`.

    Parameters
    ----------
    element : str, optional
        Only the ions in the peaks of this element.
    mass : tuple of float, optional
        Only the ions of these m/n, low <= m/n < high [Da]; a bound of None is open. Not with `element`.
    ions : tuple of int, optional
        First ion, and the one after the last, in the order of the file; a bound of None is open.
    ranges : str, optional
        File of ranges of mass in which `element` is a species.
    """

    element: str | None = None
    mass: tuple[float | None, float | None] | None = None
    ions: tuple[float | None, float | None] | None = None
    ranges: str | None = None

    def of(self, file: MeasuredFile) -> MeasuredFile:
        """The file with this selection."""
        if self.ranges is None or self.element is None:
            return replace(file, peaks=self.element, mass=self.mass, ions=self.ions)
        return replace(file, ranges=self.ranges, species=self.element, peaks=None, mass=self.mass, ions=self.ions)


class MeasuredIons:
    """Measured ions and their selection.

    Raises
    ------
    ValueError
        If the selection has no ions.
    """

    def __init__(self, hits: Hits, file: MeasuredFile | None = None) -> None:
        self.file = MeasuredFile("MEASURED") if file is None else file
        self._columns, self._start = hits.columns, "measured" if file is None else ""
        # what the page does not change
        fixed = IonSelection().of(self.file)
        self.distance, self.time_zero = self.file.distance, self.file.time_zero
        self.flight: tuple[float, float] | None = None
        """Flight length [mm] and time zero [ns] that the last spectrum fitted; those of the user stay."""
        self.ranges: str | None = None
        """File of ranges of mass by which the peaks are named; None for names by their isotopes."""
        if self.file.species is None:  # otherwise their masses are those of the options
            fixed = replace(fixed, distance=None)
        self.all = hits if file is None else fixed.ions_of_map(hits)
        self.selection = IonSelection()
        self._in_ranges = False  # whether `file` has the ranges of a selection
        self.hits = self.all
        """The ions that are shown."""
        chosen = IonSelection(self.file.peaks, self.file.mass, self.file.ions)
        if chosen != self.selection:
            self.select(chosen)

    @property
    def number(self) -> int:
        """Number of the ions of the file, as far as it is known."""
        ion = self.all.ion
        return len(self.all) if ion is None or not len(ion) else int(ion.max()) + 1

    @property
    def lacks_distance(self) -> bool:
        """Whether masses only need a flight length."""
        return self.all.mass_to_charge is None and self.distance is None and not self.lacks_times

    @property
    def has_masses(self) -> bool:
        """Whether masses are known, or can be computed."""
        return self.all.mass_to_charge is not None or self._computes

    @property
    def lacks_times(self) -> bool:
        """Whether there are no times of flight, or no voltages."""
        return self.all.time_of_flight is None or self.all.voltage is None

    def spectrum(self, elements: Sequence[str] | None = None) -> Spectrum:
        """Spectrum of all ions; as for `apt_evap.spectrum`."""
        distance = self.distance if self._computes else None
        ranges = None if self.ranges is None else read_ranges(self.ranges)
        named = spectrum(self.all, elements, ranges, distance=distance, time_zero=self.time_zero)
        fitted = named.flight if named.flight is not None and named.flight.peaks else None
        self.flight = None if fitted is None else (round(fitted.distance, 2), round(fitted.time_zero, 2))
        return named

    def select(self, selection: IonSelection) -> Hits:
        """Show a part of the ions, and return it."""
        flight = self.distance, self.time_zero
        if self.flight is not None and (selection.mass is not None or selection.ranges is not None):
            flight = self.flight  # the masses of the spectrum
        distance, time_zero = flight
        hits = selection.of(MeasuredFile(self.file.path, distance=distance, time_zero=time_zero)).select(self.all)
        self.selection, self.hits = selection, hits
        before = replace(self.file, species=None, ranges=None) if self._in_ranges else self.file
        self._in_ranges = selection.ranges is not None
        self.file = selection.of(replace(before, distance=distance, time_zero=time_zero))
        return hits

    def show(self, hits: Hits) -> None:
        """Show ions until `select` has those of a selection."""
        self.hits = hits

    @property
    def arguments(self) -> list[str]:
        """Arguments of ``apt-evap`` that read and select the same ions."""
        return self.file.words()

    @property
    def code(self) -> str:
        """Python expression of the same ions."""
        return self.file.code(self._columns, self._start)

    @property
    def _computes(self):
        """Whether masses follow from the times of flight."""
        return self.all.mass_to_charge is None and self.distance is not None and not self.lacks_times
