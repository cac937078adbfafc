"""Maps of a run for any emission, on the bins of a measured map: the numbers of the explorer, without its page."""

import math
import time
import warnings
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from apt_evap._common.validation import check_array, check_count, check_kind, check_number
from apt_evap.detection.binning import bins_for, field_of_view
from apt_evap.detection.detector_map import DetectorMap
from apt_evap.detection.hits import Hits
from apt_evap.emission.perturbations import Perturbation, RollUp, TruncatedNormal, Unperturbed
from apt_evap.explore.controls import MECHANISMS, Control, controls_of, perturbation_of
from apt_evap.explore.explorer_maps import ExplorerMaps, ExplorerSettings
from apt_evap.explore.explorer_text import Commands, ExplorerText
from apt_evap.explore.measured_ions import MeasuredIons
from apt_evap.explore.poles_of_run import PolesOfRun
from apt_evap.explore.registration_search import RegistrationSearch
from apt_evap.fit.measured_map import BINS, measured_map
from apt_evap.io.measured_file import MeasuredFile
from apt_evap.maps.profiles import Profile, Rectangle, zone_line_profile
from apt_evap.maps.registration.register import Registration
from apt_evap.maps.similarity import WINDOW, similarity, similarity_ceiling, window_fits
from apt_evap.simulation.run import Run
from apt_evap.warnings import AptWarning

PREVIEW = 50_000
"""Ions of a preview. Measured: 22 ms for maps of this many, `RollUp`, 256 bins and one thread of an Intel Xeon."""
REGION = RollUp(TruncatedNormal(0.155, 0.155))
"""Second perturbation, beside none, whose map limits the common region: energies of Shaikh et al. (2025) for nickel."""
_PERTURBATIONS = 2  # whose positions are kept: one may be that of a preview


class Explorer:
    """Maps of a run for any emission, fast enough to follow a slider, a measured map, or both.

    All maps have the same bits as those of `Run.hits` and `Hits.map`.

    Parameters
    ----------
    run : Run, optional
        A run at the simulated voltage or in real units. Without responses only the emission that it was flown with is
        shown.
    measured : Hits or MeasuredIons or DetectorMap, optional
        Measured ions, with a selection of them, or a map.
    registration : Registration, optional
        Transform into the measured frame. By default only scaled to the same size, until `register` is called, which
        takes up to some minutes.
    preview : int
        Number of ions of a preview; runs of up to this many have no previews.
    run_code : str
        Python expression of the run, for `commands`.
    run_arguments : sequence of str
        The same as arguments of ``apt-evap``.
    file : MeasuredFile, optional
        How the measured ions or the map were read.

    Raises
    ------
    ValueError
        If an argument is missing.
    """

    def __init__(
        self,
        run: Run | None = None,
        measured: Hits | MeasuredIons | DetectorMap | None = None,
        registration: Registration | None = None,
        *,
        preview: int = PREVIEW,
        run_code: str = "run",
        run_arguments: Sequence[str] = ("RUN.h5",),
        file: MeasuredFile | None = None,
    ) -> None:
        if run is None and measured is None:
            raise ValueError("the explorer needs a run, measured ions or a measured map, got none")
        if run is not None:
            check_kind(run, "run", Run, "a Run")
        if registration is not None:
            check_kind(registration, "registration", Registration, "a Registration")
            if measured is None or run is None:
                raise ValueError("registration needs a run, and measured ions or a measured map, got only one of them")
        preview = check_count(preview, "preview", at_least=1)
        self.run: Any = run
        self.ions_of_file = MeasuredIons(measured, file) if isinstance(measured, Hits) else measured
        """All measured ions of the file and the selection of them, a map, or None."""
        self.measured: Any = measured.hits if isinstance(measured, MeasuredIons) else measured
        self.run_code, self._map_file = run_code, file
        self._run_arguments = [] if run is None else list(run_arguments)
        step = 1 if run is None else math.ceil(len(run) / preview)
        self._preview_run: Any = run if run is None or step == 1 else run[::step]
        self._kept_places: list[tuple[Any, Hits]] = []
        self._kept_maps: dict[Any, Any] = {}
        self._kept_picture: tuple[Any, Any] = (None, None)
        self.registered = registration is not None
        """Whether the registration was found or given, not only set to show both maps in the same size."""
        self.registration = registration
        self.crystal = ""
        """Name of the crystal of the measurement, if it is known and one of the table."""
        self.crystal_of_ions = ""
        """Element of most of the measured ions by their masses, if the spectrum has named them."""
        self.notes: tuple[str, ...] = ()
        """Texts of the warnings of reading the files."""
        self.poles: Any = None if run is None else PolesOfRun(run)
        self.search: Any = None if run is None else RegistrationSearch(run)
        if run is not None and measured is not None and registration is None:
            self.registration = self._same_size()

    @property
    def distance(self) -> float | None:
        """Flight length of the measured ions that was given [mm]."""
        return self.ions_of_file.distance if isinstance(self.ions_of_file, MeasuredIons) else None

    @property
    def is_comparison(self) -> bool:
        """Whether there are a run and a measurement."""
        return self.run is not None and self.measured is not None

    def selection_changed(self) -> None:
        """Take the ions that are now selected of the file."""
        if isinstance(self.ions_of_file, MeasuredIons):
            self.measured = self.ions_of_file.hits
            if self.search is not None:
                self.search.forget_ions()
            self._kept_maps, self._kept_picture = {}, (None, None)

    def keep_ions(self, other: "Explorer") -> None:
        """Keep the selection of ions of another explorer, if it has the same measurement."""
        mine, theirs = self.ions_of_file, other.ions_of_file
        if not (
            isinstance(mine, MeasuredIons) and isinstance(theirs, MeasuredIons) and other.names[1] == self.names[1]
        ):
            return
        if _are_equal(mine.all, theirs.all):  # the file may have been replaced, or read with other options
            self.ions_of_file = theirs
            self.selection_changed()
            if self.is_comparison and not self.registered:
                self.registration = self._same_size()

    @property
    def names(self) -> tuple[str, str]:
        """Files of the run and of the measurement, empty without one."""
        first, second = (words[0] if words else "" for words in (self._run_arguments, self.words_of_measurement))
        return first, second

    # ---- maps ------------------------------------------------------------------------------------------------------

    @property
    def start(self) -> ExplorerSettings:
        """Settings at the start: roll-up with the energies of Shaikh et al. (2025) for nickel, smoothed by one bin."""
        perturbation = self._emissions[-1]
        if self.has_sliders:
            perturbation = perturbation_of("roll-up", _starting_values("roll-up"))
        if isinstance(self.measured, DetectorMap):
            bins = max(self.measured.values.shape)
        else:
            bins = bins_for(len(self.run)) if self.measured is None else BINS
        return ExplorerSettings(perturbation, bins, self.smoothing_for(bins))

    @property
    def has_sliders(self) -> bool:
        """Whether any emission can be shown: without a run, or for a run with responses."""
        return self.run is None or self.run.responses is not None

    @property
    def _emissions(self) -> tuple[Perturbation, ...]:
        """Emissions whose maps limit the common region."""
        return (Unperturbed(), REGION) if self.has_sliders else (self.run.first_perturbation,)

    def _same_size(self):
        """Registration by the size of both fields of view alone."""
        hits, target = self._preview_run.hits(self._emissions[0]), measured_map(self.measured)
        x, y = np.meshgrid(*target.centres)
        fields = [(hits.x[hits.detected], hits.y[hits.detected]), (x[target.mask], y[target.mask])]
        boxes = [np.percentile(field, [1, 99], axis=1) for field in fields]
        simulated, measured = (float(np.ptp(box, axis=0).max()) for box in boxes)
        shift = boxes[1].mean(axis=0) - measured / simulated * boxes[0].mean(axis=0)
        return Registration(0.0, measured / simulated, tuple(shift.tolist()))

    def smoothing_for(self, bins: int) -> float:
        """Smoothing by one bin, to two digits [mm]."""
        return float(f"{max(self.bins_like(bins).bin_size):.2g}")

    def controls(self, mechanism: str) -> tuple[Control, ...]:
        """Controls of a mechanism, with heights that this run permits."""
        height = self.run.response_settings.height
        return tuple(
            replace(control, high=height) if control.name == "height" else control for control in controls_of(mechanism)
        )

    @property
    def first_and_last(self) -> tuple[int, int]:
        """Number of the first ion, and of the last one plus 1."""
        ions = self.run.emissions.ions
        return int(ions[0]), int(ions[-1]) + 1

    def register(
        self,
        perturbations: Sequence[Perturbation] | None = None,
        progress: Callable[[float, int], None] | None = None,
        apply: Callable[..., Registration] | None = None,
    ) -> Registration:
        """Set the registration at each emission that is better than those before, see `RegistrationSearch.best`.

        By default one emission of each mechanism is tried. The best one is returned; it may be doubtful, with a
        warning.
        """
        if not self.is_comparison:
            raise ValueError("a registration needs a run, and measured ions or a measured map, got only one of them")
        if perturbations is None and self.has_sliders:
            perturbations = [perturbation_of(name, _starting_values(name)) for name in MECHANISMS]
        elif perturbations is None:
            perturbations = self._emissions
        target = measured_map(self.measured)
        best = self.search.best(target, self.distance, perturbations, self.set_registration, progress, apply)
        self.set_registration(best)
        best.warn_if_doubtful()
        return best

    def set_registration(self, registration: Registration) -> None:
        """Set the transform into the measured frame."""
        self.registration = check_kind(registration, "registration", Registration, "a Registration")
        self.registered = True
        self._kept_places, self._kept_maps = [], {}

    def show(self, settings: ExplorerSettings, preview: bool = False) -> ExplorerMaps:
        """Compute maps; ValueError if no ion is on the map.

        A preview has evenly spaced ions, at most the number of a preview. Their noise lowers the similarity.
        """
        start = time.perf_counter()
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always", AptWarning)
            like = self.bins_like(settings.bins)
            simulated = whole = alike = ceiling = None
            pictures: tuple[DetectorMap, ...] = ()
            if self.run is not None:
                hits = self.hits(settings, preview)
                simulated = hits.map(like=like, position_step=None)
                flat = simulated.flattened(settings.flattening)
                pictures = (flat.smoothed(settings.smoothing),)
            if self.measured is not None:
                measured, picture, whole = self._measured_pictures(settings)
                pictures += (picture,)
                if self.registered and _has_window(like):
                    alike = similarity(flat, measured, smoothing=settings.smoothing)
                    ceiling = self._ceiling(settings)
        return ExplorerMaps(
            settings=settings,
            simulated=simulated,
            measured=None if self.measured is None else like,
            pictures=pictures,
            whole=whole,
            similarity=alike,
            ceiling=ceiling,
            ions=0 if self.run is None else len(hits),
            preview=preview and self._preview_run is not self.run,
            seconds=time.perf_counter() - start,
            notes=tuple(str(warning.message) for warning in caught if issubclass(warning.category, AptWarning)),
        )

    def hits(self, settings: ExplorerSettings, preview: bool = False) -> Hits:
        """Simulated ions of the maps, in the measured frame if there is a measurement; with x, y, ion and outcome."""
        run: Any = self._preview_run if preview else self.run
        registration = self.registration  # may be set by another thread
        key = settings.perturbation, run is self.run, registration
        places = next((hits for kept_key, hits in self._kept_places if kept_key == key), None)
        if places is None:
            x, y, outcome = run.places(settings.perturbation)
            if registration is not None:
                x, y = registration.points(x, y)
            places = Hits(x=x, y=y, ion=run.emissions.ions, outcome=outcome, source="simulation")
            self._kept_places = [*self._kept_places, (key, places)][-_PERTURBATIONS:]
        return places if settings.ions is None else places[slice(*np.searchsorted(run.emissions.ions, settings.ions))]

    def bins_like(self, bins: int) -> DetectorMap:
        """Map whose bins and mask all maps have, with about this number of bins along the longer side.

        It is the measured map, with a run within the region that the simulated maps cover, and without a measurement
        the unperturbed map of the run. ValueError if no bin remains.
        """
        key = bins, self.registration
        if key not in self._kept_maps:
            if self.measured is None:
                self._kept_maps[key] = self._bins_of_run(bins)
            else:
                self._kept_maps[key] = self._complete(bins) if self.run is None else self._region(*key)
        return self._kept_maps[key]

    def _complete(self, bins):
        """The complete measured map."""
        key = "complete", bins
        if key not in self._kept_maps:
            self._kept_maps[key] = measured_map(self.measured, bins)
        return self._kept_maps[key]

    def _bins_of_run(self, bins):
        """Map on the complete detector, as `apt-evap map` makes it."""
        return self.run.hits(self._emissions[0]).map(like=self.run.grid(bins), position_step=None)

    def _region(self, bins, registration):
        measured = self._complete(bins)
        mask = measured.mask & field_of_view(np.where(measured.mask, measured.values, 0))
        for perturbation in self._emissions:
            hits = registration.hits(self._preview_run.hits(perturbation))
            mask &= field_of_view(hits.map(like=measured, position_step=None).counts)
        if not mask.any():
            raise ValueError(f"the simulated map, {registration}, does not cover the measured one")
        ions = int(measured.values[mask].sum()) if measured.is_counts else None
        return replace(measured, mask=mask, ions=ions, detected=None)

    def _measured_pictures(self, settings):
        """The measured map flattened, also smoothed, and this of the complete one; kept until settings change them."""
        key = settings.bins, settings.flattening, settings.smoothing, self.registration
        if self._kept_picture[0] != key:
            flat = self.bins_like(settings.bins).flattened(settings.flattening)
            picture = whole = flat.smoothed(settings.smoothing)
            if self.run is not None:
                whole = self._complete(settings.bins).flattened(settings.flattening).smoothed(settings.smoothing)
            self._kept_picture = key, (flat, picture, whole)
        return self._kept_picture[1]

    def _ceiling(self, settings):
        like = self.bins_like(settings.bins)
        if not like.is_counts or settings.flattening:
            return None
        key = "ceiling", settings.bins, settings.smoothing, self.registration
        if key not in self._kept_maps:
            self._kept_maps[key] = similarity_ceiling(like, smoothing=settings.smoothing)
        return self._kept_maps[key]

    # ---- what is on a map ------------------------------------------------------------------------------------------

    def profiles(self, maps: ExplorerMaps, ends: Any, width: float) -> tuple[Rectangle, tuple[Profile, ...]]:
        """Region along a line with ends of shape (2, 2) [mm], and the profile of each map across this width [mm]."""
        (x0, y0), (x1, y1) = check_array(ends, "ends", (2, 2)).tolist()
        length = math.hypot(x1 - x0, y1 - y0)
        rectangle = Rectangle(((x0 + x1) / 2, (y0 + y1) / 2), math.degrees(math.atan2(y1 - y0, x1 - x0)), length, width)
        bins = max(2, int(width / maps.bin_size))
        return rectangle, tuple(zone_line_profile(counts, rectangle, bins=bins) for counts in maps.present)

    def atoms_at(self, settings: ExplorerSettings, x: float, y: float, radius: float) -> Hits:
        """Atoms of the specimen whose ions land within a circle on the map [mm].

        They have their places on the map, `positions` in the specimen [nm], `site`, `ion`, and in `extra` the charge
        [e] and field [V/nm] at the simulated voltage.
        """
        hits = self.hits(settings)
        centre = check_array((x, y), "x and y", (2,))
        radius = check_number(radius, "radius", above=0, unit="mm")
        inside = hits.detected & (np.hypot(hits.x - centre[0], hits.y - centre[1]) <= radius)
        rows = np.searchsorted(self.run.emissions.ions, hits.ion[inside])  # type: ignore[index]
        return Hits(
            x=hits.x[inside],  # type: ignore[index]
            y=hits.y[inside],  # type: ignore[index]
            ion=hits.ion[inside],  # type: ignore[index]
            site=self.run.site[rows],
            positions=self.run.emissions.positions[rows],
            extra={"charge": self.run.charges[rows], "field": self.run.fields[rows]},
            units={"charge": "e", "field": "V/nm"},
            source=hits.source,
        )

    # ---- text ------------------------------------------------------------------------------------------------------

    def commands(self, settings: ExplorerSettings) -> Commands:
        """Command line and Python lines that give the same maps."""
        return ExplorerText(self).commands(settings)

    def selection(self, settings: ExplorerSettings, x: tuple[float, float], y: tuple[float, float]) -> Commands:
        """Command line and Python lines that select the ions within a rectangle on the map, see `ExplorerText`."""
        return ExplorerText(self).selection(settings, x, y)

    @property
    def words_of_run(self) -> list[str]:
        """Arguments of a command line that name the run, empty without one."""
        return self._run_arguments

    @property
    def words_of_measurement(self) -> list[str]:
        """Arguments of a command line that name the measurement and its selection, empty without one."""
        if isinstance(self.ions_of_file, MeasuredIons):
            return self.ions_of_file.arguments
        if self.measured is None:
            return []
        return ["MEASURED"] if self._map_file is None else self._map_file.words()

    @property
    def code_of_measurement(self) -> str:
        """Python expression of the measurement."""
        if isinstance(self.ions_of_file, MeasuredIons):
            return self.ions_of_file.code
        return "measured" if self._map_file is None else self._map_file.code(())


def _has_window(like):
    """Whether `similarity` has a window within the mask."""
    return min(like.values.shape) > 2 * WINDOW and bool(window_fits(like.mask).any())


def _starting_values(mechanism):
    return {control.name: control.value for control in controls_of(mechanism)}


def _are_equal(first, second):
    """Whether two `Hits` have the same columns with the same values."""
    one, two = ({name: getattr(hits, name) for name in hits.columns} | hits.extra for hits in (first, second))
    return one.keys() == two.keys() and all(
        values.dtype == two[name].dtype and np.array_equal(values, two[name], equal_nan=values.dtype.kind == "f")
        for name, values in one.items()
    )
