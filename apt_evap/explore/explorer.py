"""Maps of a run for any emission, on the bins of a measured map: the numbers of the explorer, without its page."""

import math
import time
import warnings
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import replace
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np

from apt_evap._common.validation import check_array, check_count, check_kind, check_number
from apt_evap.analysis.apex import image_compression
from apt_evap.detection.binning import bins_for, field_of_view
from apt_evap.detection.detector_map import DetectorMap
from apt_evap.detection.hits import Hits
from apt_evap.detection.projection import Projection
from apt_evap.emission.perturbations import Perturbation, RollUp, TruncatedNormal, Unperturbed
from apt_evap.explore.controls import MECHANISMS, Control, controls_of, perturbation_of
from apt_evap.explore.explorer_maps import ExplorerMaps, ExplorerSettings
from apt_evap.explore.explorer_text import Commands, ExplorerText
from apt_evap.explore.marks import Overlay, overlay
from apt_evap.explore.measured_ions import MeasuredIons
from apt_evap.explore.placement import misplaced
from apt_evap.fit.confirmation import confirmed
from apt_evap.fit.indexed_registration import index_as_run, indexed_start, register_near
from apt_evap.fit.measured_map import BINS, measured_map
from apt_evap.fit.structure import PoleMeasure, RegisteredProjection
from apt_evap.io.measured_file import MeasuredFile
from apt_evap.maps.crystallography.directions import poles
from apt_evap.maps.crystallography.orientation import Orientation
from apt_evap.maps.crystallography.symmetry import pole_symmetry
from apt_evap.maps.profiles import Profile, Rectangle, zone_line_profile
from apt_evap.maps.registration.register import Registration, register
from apt_evap.maps.registration.verdict import Likeness, likeness, symmetric_places
from apt_evap.maps.rings import Ring, ring_statistics
from apt_evap.maps.similarity import WINDOW, similarity, similarity_ceiling, window_fits
from apt_evap.simulation.run import Run
from apt_evap.warnings import AptWarning

PREVIEW = 50_000
"""Ions of a preview. Measured: 22 ms for maps of this many, `RollUp`, 256 bins and one thread of an Intel Xeon."""
REGION = RollUp(TruncatedNormal(0.155, 0.155))
"""Second perturbation, beside none, whose map limits the common region: energies of Shaikh et al. (2025) for nickel."""
_PERTURBATIONS = 2  # whose positions are kept: one may be that of a preview
_FAMILIES = 6  # of poles over the maps
_NEAR = 15.0  # degrees: a pole farther from the axis of the specimen is not that of its apex


class Pole(NamedTuple):
    """Pole near the axis of a specimen."""

    label: str
    """Indices in the math syntax of matplotlib; "axis" for a specimen without a crystal."""
    place: tuple[float, float]
    """Position on the map [mm]."""
    fold: int
    """Rotational symmetry of the poles about it."""


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
        self.registration_options: dict[str, Any] = {}
        """Options of `register` that say where the run is on the measurement."""
        self._indexed_start: dict[str, Any] | None = None  # the same by an indexing of these ions; {} if undecided
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
            self._indexed_start = None
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
        """Register the run on the measurement: the best of several emissions. Returns `registration`.

        It is set at each emission that is better than those before and not doubtful, and at the end.

        Parameters
        ----------
        perturbations : sequence of perturbation, optional
            Emissions to try; by default one of each mechanism.
        progress : callable, optional
            Called at the start and after each emission, with the number of those that are done, and of all. The
            indexing of the measured map is the first of them if it is not known yet, and is told in parts. An error
            that it raises ends the search.
        apply : callable, optional
            Calls a function with a tuple of arguments, such as `SearchProcess.call`.

        Returns
        -------
        Registration

        Raises
        ------
        ValueError
            If there is no run or no measurement, or as in `register`.

        Warns
        -----
        RegistrationWarning
            If the best registration is doubtful.
        """
        if self.run is None or self.measured is None:
            raise ValueError("a registration needs a run, and measured ions or a measured map, got only one of them")
        target = measured_map(self.measured)
        if perturbations is None and not self.has_sliders:
            perturbations = self._emissions
        if perturbations is None:
            perturbations = [perturbation_of(name, _starting_values(name)) for name in MECHANISMS]
        call = apply or (lambda function, arguments, options={}, progress=None: function(*arguments, **options))
        best: Registration | None = None
        registration: Registration | None
        failed = ValueError("perturbations must contain at least one perturbation, got none")
        progress = progress or (lambda done, number: None)
        indexes = not self.registration_options and self._indexed_start is None
        number = len(perturbations) + indexes
        progress(0, number)
        options = self._start(target, call, lambda part: progress(part, number))
        for done, perturbation in enumerate(perturbations, 1 + indexes):
            arguments = self.run.hits(perturbation), target, options
            try:
                registration = call(_registration, arguments)
            except ValueError as error:  # such as a map that is too empty with this emission
                registration, failed = None, error
            progress(done, number)
            if registration is not None and (best is None or registration.score > best.score):
                best = registration
                if not best.doubtful:
                    self.set_registration(best)
        if best is None:
            raise failed
        self.set_registration(best)
        best.warn_if_doubtful()
        return best

    def _start(self, target, call, progress):
        """Options that say where the run is: given ones, or by an indexing of the measured map, once for its ions."""
        if self.registration_options:
            return self.registration_options
        if (start := self._indexed_start) is None:
            start = {}
            arguments = target, Orientation.known(self.run.settings["tip"]), self.distance
            indexing = call(index_as_run, arguments, {}, progress)
            if indexing is not None and indexing.decided:
                with suppress(ValueError):  # the axis of the run is not on the map
                    start = indexed_start(self.run, indexing)
            self._indexed_start = start
        return start

    def set_registration(self, registration: Registration) -> None:
        """Set the transform into the measured frame."""
        self.registration = check_kind(registration, "registration", Registration, "a Registration")
        self.registered = True
        self._kept_places, self._kept_maps = [], {}

    def show(self, settings: ExplorerSettings, preview: bool = False) -> ExplorerMaps:
        """Compute maps.

        Parameters
        ----------
        settings : ExplorerSettings
            Emission, bins, smoothing and ions.
        preview : bool
            Whether to use evenly spaced ions, at most the number of a preview. Their noise lowers the similarity.

        Returns
        -------
        ExplorerMaps

        Raises
        ------
        ValueError
            If no ion is on the map.
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
        """Simulated ions of the maps, in the measured frame if there is a measurement.

        Parameters
        ----------
        settings : ExplorerSettings
            Settings of the maps.
        preview : bool
            As for `show`.

        Returns
        -------
        Hits
            With x, y, ion and outcome.
        """
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
        """Map whose bins and mask all maps with this number of bins have.

        Parameters
        ----------
        bins : int
            Number of bins along the longer side; approximate with a measurement.

        Returns
        -------
        DetectorMap
            The measured map, with a run within the region that the simulated maps cover; without a measurement the
            unperturbed map of the run.

        Raises
        ------
        ValueError
            If no bin remains.
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

    @cached_property
    def _projection(self):
        """Projection from the specimen onto the detector."""
        return image_compression(self.run).projection

    @cached_property
    def _pole(self):
        """Label, direction in the specimen and symmetry of the pole nearest to the axis."""
        orientation = Orientation.known(self.run.settings["tip"])
        if orientation is not None:
            family = poles(orientation.material)
            directions = orientation.directions(family.normals)
            nearest = int(directions[:, 2].argmax())
            if directions[nearest, 2] > math.cos(math.radians(_NEAR)):
                fold = pole_symmetry(orientation.material, family.normals[nearest]).order
                return family.labels[nearest], directions[nearest], fold
        return "axis", np.array([0.0, 0.0, 1.0]), 1

    @property
    def pole(self) -> Pole:
        """The pole nearest to the axis of the specimen, or the axis if there is none within 15 degrees.

        Raises
        ------
        ValueError
            If the run has too few ions for its image compression.
        """
        text, direction, fold = self._pole
        x, y = self._projection.places(direction[None])[0]
        if self.registration is not None:
            x, y = self.registration.points(x, y)
        return Pole(text, (float(x), float(y)), fold)

    def poles_over(self, maps: ExplorerMaps) -> Overlay | None:
        """Poles and zone lines of the specimen on the maps, None without a crystal or with too few ions."""
        orientation = Orientation.known(self.run.settings["tip"])
        if orientation is None:
            return None
        try:
            projection = self._projection
        except ValueError:  # too few ions
            return None
        if self.registration is not None:
            projection = RegisteredProjection(projection, self.registration)
        like = maps.pictures[-1] if maps.whole is None else maps.whole
        drawn = overlay(orientation, projection, like, _FAMILIES)
        inside = np.flatnonzero(like.contains(*drawn.places.T))
        return drawn._replace(places=drawn.places[inside], labels=tuple(drawn.labels[k] for k in inside))

    def rings(self, maps: ExplorerMaps) -> tuple[tuple[Ring, ...], ...]:
        """Statistics of rings about the pole, of the simulated and of the measured map.

        Parameters
        ----------
        maps : ExplorerMaps
            Maps, neither flattened nor smoothed for this.

        Returns
        -------
        tuple of tuple of Ring
            For each map the default rings of `ring_statistics`.

        Raises
        ------
        ValueError
            If a ring is outside the map or has too few ions.

        Notes
        -----
        Both maps have the same projection, that of the run, centred on the pole and scaled by the registration.
        """
        pole = self.pole
        scale = 1.0 if self.registration is None else self.registration.scale
        projection = Projection(self._projection.scale * scale, pole.place, compression=self._projection.compression)
        return tuple(ring_statistics(counts, projection, fold=pole.fold) for counts in _present(maps))

    def likeness(self, maps: ExplorerMaps) -> Likeness:
        """Whether both maps show the same crystal along the same axis, as `Study.likeness`, and lie on each other."""
        assert maps.simulated is not None and maps.measured is not None and self.registration is not None
        arguments = maps.simulated, maps.measured, self.registration
        try:
            projection = self._projection
        except ValueError:  # too few ions
            projection = None
        orientation = Orientation.known(self.run.settings["tip"])
        result = likeness(*arguments, about=symmetric_places(orientation, projection))
        if result.verdict == "alike":
            result = confirmed(result, *self._structures(maps))
        if result.verdict == "alike" and (why := misplaced(*arguments)):
            return result._replace(verdict="doubtful", reason=f"{result.reason}, but {why}: check the registration")
        return result

    def _structures(self, maps):
        """Structure of both maps about a pole, None without one whose rings are on the maps."""
        measure, measured = self._measured_structure(maps)
        if measure is None:
            return None, None
        return measure.structure(maps.simulated), measured

    def _measured_structure(self, maps):
        """Measure of a pole, and the structure of the measured map, kept for all emissions; None without a pole."""
        key = "structure", maps.settings.bins, self.registration
        if key not in self._kept_maps:
            try:
                measure = PoleMeasure(self.run, self.registration, maps.measured)
            except ValueError:
                self._kept_maps[key] = None, None
            else:
                self._kept_maps[key] = measure, measure.structure(maps.measured)
        return self._kept_maps[key]

    def profiles(self, maps: ExplorerMaps, ends: Any, width: float) -> tuple[Rectangle, tuple[Profile, ...]]:
        """Profiles across a line on the maps.

        Parameters
        ----------
        maps : ExplorerMaps
            The maps; counts and densities as they are, not smoothed.
        ends : array_like
            Ends of the line [mm], shape (2, 2).
        width : float
            Width of the profile across the line [mm].

        Returns
        -------
        rectangle : Rectangle
            Region along the line.
        profiles : tuple of Profile
            `zone_line_profile` of the simulated and of the measured map, as far as there are both.

        Raises
        ------
        ValueError
            If the line has no length, or a map has no hits along it.
        """
        (x0, y0), (x1, y1) = check_array(ends, "ends", (2, 2)).tolist()
        length = math.hypot(x1 - x0, y1 - y0)
        rectangle = Rectangle(((x0 + x1) / 2, (y0 + y1) / 2), math.degrees(math.atan2(y1 - y0, x1 - x0)), length, width)
        bins = max(2, int(width / maps.bin_size))
        return rectangle, tuple(zone_line_profile(counts, rectangle, bins=bins) for counts in _present(maps))

    def atoms_at(self, settings: ExplorerSettings, x: float, y: float, radius: float) -> Hits:
        """Atoms of the specimen whose ions land within a circle on the map.

        Parameters
        ----------
        settings : ExplorerSettings
            Emission and ions.
        x, y : float
            Centre of the circle [mm].
        radius : float
            Radius of the circle [mm].

        Returns
        -------
        Hits
            Places on the map, `positions` in the specimen [nm], `site`, `ion`, and in `extra` the charge [e] and
            field [V/nm] at the simulated voltage.
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


def _registration(simulated, measured, options):
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", AptWarning)  # given once, for the best one
        if "start" in options:
            return register_near(simulated, measured, options)
        return register(simulated, measured, **options)


def _present(maps):
    return [counts for counts in (maps.simulated, maps.measured) if counts is not None]


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
