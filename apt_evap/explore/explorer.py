"""Maps of a run for any emission, on the bins of a measured map: the numbers of the explorer, without its page."""

import math
import shlex
import time
import warnings
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np

from apt_evap._common.codec import to_python
from apt_evap._common.validation import check_array, check_count, check_kind, check_number, check_sequence
from apt_evap.analysis.apex import image_compression
from apt_evap.config.perturbation_text import write_perturbation
from apt_evap.crystallography.directions import poles
from apt_evap.crystallography.orientation import Orientation
from apt_evap.crystallography.symmetry import rotational_symmetry
from apt_evap.detection.binning import bins_for, field_of_view
from apt_evap.detection.detector_map import DetectorMap
from apt_evap.detection.hits import Hits
from apt_evap.detection.limits import MAX_BINS
from apt_evap.detection.projection import Projection
from apt_evap.emission.perturbations import Perturbation, RollUp, TruncatedNormal, Unperturbed
from apt_evap.explore.controls import MECHANISMS, Control, controls_of, perturbation_of
from apt_evap.fit.fit_energies import BINS, measured_map
from apt_evap.maps.profiles import Profile, Rectangle, zone_line_profile
from apt_evap.maps.rings import Ring, ring_statistics
from apt_evap.maps.similarity import WINDOW, Similarity, similarity, similarity_ceiling, window_fits
from apt_evap.registration.register import Registration, register
from apt_evap.simulation.run import Run
from apt_evap.warnings import AptWarning

PREVIEW = 50_000
"""Ions of a preview. Measured: 22 ms for a view with this many, `RollUp`, 256 bins and one thread of an Intel Xeon."""
REGION = RollUp(TruncatedNormal(0.155, 0.155))
"""Second perturbation, beside none, whose map limits the common region: the energies of the paper for nickel."""
_PERTURBATIONS = 2  # whose positions are kept: one may be that of a preview
_NEAR = 15.0  # degrees: a pole farther from the axis of the specimen is not that of its apex


@dataclass(frozen=True)
class View:
    """What a map of the explorer shows.

    Parameters
    ----------
    perturbation : perturbation
        Emission of the ions.
    bins : int
        Bins along the longer side; with a measured map, its bins are merged to come closest to this number.
    smoothing : float
        Standard deviation of the Gaussian that smooths both maps [mm]; 0 for none.
    flattening : float
        Standard deviation of the Gaussian that flattens both maps before [mm]; 0 for none.
    ions : tuple of int, optional
        First ion, and the one after the last, in the sequence of evaporation; by default all.

    Raises
    ------
    ValueError
        If a number is outside its range.
    """

    perturbation: Perturbation
    bins: int
    smoothing: float
    flattening: float = 0.0
    ions: tuple[int, int] | None = None

    def __post_init__(self):
        check_count(self.bins, "bins", at_least=1, at_most=MAX_BINS)
        for name in ("smoothing", "flattening"):
            object.__setattr__(self, name, check_number(getattr(self, name), name, at_least=0, unit="mm"))
        if self.ions is not None:
            first, last = check_sequence(self.ions, "ions", "(first, last)")
            first = check_count(first, "first ion")
            object.__setattr__(self, "ions", (first, check_count(last, "last ion", at_least=first + 1)))


@dataclass(frozen=True, eq=False)
class Shown:
    """Maps of a view of the explorer.

    Parameters
    ----------
    view : View
        The view.
    simulated : DetectorMap
        Counts of the simulated ions, in the measured frame if there is a measured map.
    measured : DetectorMap or None
        The measured map within the region that both maps cover.
    pictures : tuple of DetectorMap
        The same maps flattened and smoothed.
    similarity : Similarity or None
        `similarity` of both maps; None without a measured map or with too few bins.
    ceiling : Similarity or None
        `similarity_ceiling` of the measured counts, for comparison; None for densities and for flattened maps.
    ions : int
        Number of simulated ions, including those outside the map.
    preview : bool
        Whether these are only a part of the ions of the view.
    seconds : float
        Duration of the computation [s].
    notes : tuple of str
        Texts of the warnings.
    """

    view: View
    simulated: DetectorMap
    measured: DetectorMap | None
    pictures: tuple[DetectorMap, ...]
    similarity: Similarity | None
    ceiling: Similarity | None
    ions: int
    preview: bool
    seconds: float
    notes: tuple[str, ...]


class Pole(NamedTuple):
    """Pole near the axis of a specimen."""

    label: str
    """Indices in the math syntax of matplotlib; "axis" for a specimen without a crystal."""
    place: tuple[float, float]
    """Position on the map [mm]."""
    fold: int
    """Rotational symmetry of the poles about it."""


class Commands(NamedTuple):
    """Text that repeats what the explorer shows."""

    shell: str
    """Command line."""
    python: str
    """Python lines; the maps are `simulated` and `measured`, a selection of ions is `hits`."""


class Explorer:
    """Maps of a run for any emission, fast enough to follow a slider.

    All maps have the same bits as those of `Run.hits` and `Hits.map`.

    Parameters
    ----------
    run : Run
        A run with responses, at the simulated voltage or in real units.
    measured : Hits or DetectorMap, optional
        Measured ions, or a map.
    registration : Registration, optional
        Transform into the measured frame; by default that with the highest correlation for some emissions, found by
        `register` in up to some minutes.
    preview : int
        Number of ions of a preview; runs of up to this many have no previews.
    run_code, measured_code : str
        Python expressions of the run and of the measured ions or map, for `commands`.
    run_arguments, measured_arguments : sequence of str
        The same as arguments of ``apt-evap``.

    Raises
    ------
    ValueError
        If the run has no responses, or as in `register`.
    """

    def __init__(
        self,
        run: Run,
        measured: Hits | DetectorMap | None = None,
        registration: Registration | None = None,
        *,
        preview: int = PREVIEW,
        run_code: str = "run",
        measured_code: str = "measured",
        run_arguments: Sequence[str] = ("RUN.h5",),
        measured_arguments: Sequence[str] = ("MEASURED",),
    ) -> None:
        if check_kind(run, "run", Run, "a Run").responses is None:
            raise ValueError(f"the explorer needs a run with responses, got {run!r}")
        if registration is not None:
            check_kind(registration, "registration", Registration, "a Registration")
            if measured is None:
                raise ValueError("registration needs measured ions or a measured map, got none")
        preview = check_count(preview, "preview", at_least=1)
        self.run = run
        self.measured = measured
        self.run_code, self.measured_code = run_code, measured_code
        self._run_arguments = list(run_arguments)
        self._measured_arguments = [] if measured is None else list(measured_arguments)
        step = math.ceil(len(run) / preview)
        self._preview_run = self.run[::step] if step > 1 else self.run
        self._kept_places: list[tuple[Any, Hits]] = []
        self._kept_maps: dict[Any, Any] = {}
        self._kept_picture: tuple[Any, Any] = (None, None)
        self.registration = registration
        if measured is not None and registration is None:
            self.register([perturbation_of(name, _starting_values(name)) for name in MECHANISMS])

    # ---- maps ------------------------------------------------------------------------------------------------------

    @property
    def start(self) -> View:
        """View at the start: roll-up with the energies of the paper for nickel, smoothed by one bin."""
        perturbation = perturbation_of("roll-up", _starting_values("roll-up"))
        if isinstance(self.measured, DetectorMap):
            bins = max(self.measured.values.shape)
        else:
            bins = bins_for(len(self.run)) if self.measured is None else BINS
        return View(perturbation, bins, self.smoothing_for(bins))

    def smoothing_for(self, bins: int) -> float:
        """Smoothing by one bin, to two digits [mm]."""
        return float(f"{max(self.bins_like(bins).bin_size):.2g}")

    def controls(self, mechanism: str) -> tuple[Control, ...]:
        """Controls of a mechanism that this run serves: sharpness and height need wide responses."""
        settings, found = self.run.response_settings, controls_of(mechanism)
        if settings.rolls == 1:
            found = tuple(each for each in found if each.name != "second_roll")
        if not settings.is_wide:
            return tuple(each for each in found if each.name not in ("sharpness", "height"))
        return tuple(replace(each, high=settings.height) if each.name == "height" else each for each in found)

    @property
    def first_and_last(self) -> tuple[int, int]:
        """Number of the first ion, and of the last one plus 1."""
        ions = self.run.emissions.ions
        return int(ions[0]), int(ions[-1]) + 1

    def register(self, perturbations: Sequence[Perturbation]) -> Registration:
        """Register the run on the measurement: the best of several emissions. Sets and returns `registration`.

        Parameters
        ----------
        perturbations : sequence of perturbation
            Emissions to try.

        Returns
        -------
        Registration

        Raises
        ------
        ValueError
            If there is no measurement, or as in `register`.

        Warns
        -----
        RegistrationWarning
            If the best registration is doubtful.
        """
        if self.measured is None:
            raise ValueError("a registration needs measured ions or a measured map, got none")
        target = measured_map(self.measured)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", AptWarning)  # given once, for the best one
            found = [register(self.run.hits(each), target) for each in perturbations]
        best = max(found, key=lambda each: each.score)
        best.warn_if_doubtful()
        self.set_registration(best)
        return best

    def set_registration(self, registration: Registration) -> None:
        """Set the transform into the measured frame."""
        self.registration = check_kind(registration, "registration", Registration, "a Registration")
        self._kept_places, self._kept_maps = [], {}

    def show(self, view: View, preview: bool = False) -> Shown:
        """Compute the maps of a view.

        Parameters
        ----------
        view : View
            Emission, bins, smoothing and ions.
        preview : bool
            Whether to use evenly spaced ions, at most the number of a preview. Their noise lowers the similarity.

        Returns
        -------
        Shown

        Raises
        ------
        ValueError
            If no ion is on the map.
        """
        start = time.perf_counter()
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always", AptWarning)
            hits = self.hits(view, preview)
            like = self.bins_like(view.bins)
            simulated = hits.map(like=like, position_step=None)
            flat = simulated.flattened(view.flattening)
            pictures: tuple[DetectorMap, ...] = (flat.smoothed(view.smoothing),)
            alike = ceiling = None
            if self.measured is not None:
                measured, picture = self._measured_picture(view)
                pictures += (picture,)
                if _has_window(like):
                    alike = similarity(flat, measured, smoothing=view.smoothing)
                    ceiling = self._ceiling(view)
        return Shown(
            view=view,
            simulated=simulated,
            measured=None if self.measured is None else like,
            pictures=pictures,
            similarity=alike,
            ceiling=ceiling,
            ions=len(hits),
            preview=preview and self._preview_run is not self.run,
            seconds=time.perf_counter() - start,
            notes=tuple(str(each.message) for each in caught if issubclass(each.category, AptWarning)),
        )

    def hits(self, view: View, preview: bool = False) -> Hits:
        """Simulated ions of a view, in the measured frame if there is a measurement.

        Parameters
        ----------
        view : View
            The view.
        preview : bool
            As for `show`.

        Returns
        -------
        Hits
            With x, y, ion and outcome.
        """
        run = self._preview_run if preview else self.run
        registration = self.registration  # may be set by another thread
        key = view.perturbation, run is self.run, registration
        places = next((hits for kept_key, hits in self._kept_places if kept_key == key), None)
        if places is None:
            x, y, outcome = run.places(view.perturbation)
            if registration is not None:
                x, y = registration.points(x, y)
            places = Hits(x=x, y=y, ion=run.emissions.ions, outcome=outcome, source="simulation")
            self._kept_places = [*self._kept_places, (key, places)][-_PERTURBATIONS:]
        return places if view.ions is None else places[slice(*np.searchsorted(run.emissions.ions, view.ions))]

    def bins_like(self, bins: int) -> DetectorMap:
        """Map whose bins and mask all maps of a view have.

        Parameters
        ----------
        bins : int
            Number of bins along the longer side; approximate with a measurement.

        Returns
        -------
        DetectorMap
            The measured map within the region that the simulated maps cover, or the unperturbed map of the run.

        Raises
        ------
        ValueError
            If no bin remains.
        """
        key = bins, self.registration
        if key not in self._kept_maps:
            self._kept_maps[key] = self._bins_of_run(bins) if self.measured is None else self._region(*key)
        return self._kept_maps[key]

    def _bins_of_run(self, bins):
        """Map on the complete detector, as `apt-evap map` makes it."""
        return self.run.hits(Unperturbed()).map(like=self.run.grid(bins), position_step=None)

    def _region(self, bins, registration):
        measured = measured_map(self.measured, bins)
        mask = measured.mask & field_of_view(np.where(measured.mask, measured.values, 0))
        for perturbation in (Unperturbed(), REGION):
            hits = registration.hits(self._preview_run.hits(perturbation))
            mask &= field_of_view(hits.map(like=measured, position_step=None).counts)
        if not mask.any():
            raise ValueError(f"the simulated map, {registration}, does not cover the measured one")
        ions = int(measured.values[mask].sum()) if measured.is_counts else None
        return replace(measured, mask=mask, ions=ions, detected=None)

    def _measured_picture(self, view):
        """The measured map flattened, and also smoothed; the same objects as long as a view changes neither."""
        key = view.bins, view.flattening, view.smoothing, self.registration
        if self._kept_picture[0] != key:
            flat = self.bins_like(view.bins).flattened(view.flattening)
            self._kept_picture = key, (flat, flat.smoothed(view.smoothing))
        return self._kept_picture[1]

    def _ceiling(self, view):
        like = self.bins_like(view.bins)
        if not like.is_counts or view.flattening:
            return None
        key = "ceiling", view.bins, view.smoothing, self.registration
        if key not in self._kept_maps:
            self._kept_maps[key] = similarity_ceiling(like, smoothing=view.smoothing)
        return self._kept_maps[key]

    # ---- what is on a map ------------------------------------------------------------------------------------------

    @cached_property
    def _projection(self):
        """Projection from the specimen onto the detector."""
        return image_compression(self.run).projection

    @cached_property
    def _pole(self):
        """Label, direction in the specimen and symmetry of the pole nearest to the axis."""
        tip = self.run.settings["tip"]
        if "axis" in tip:
            orientation = Orientation.from_settings(tip)
            family = poles(orientation.material)
            directions = orientation.directions(family.normals)
            nearest = int(directions[:, 2].argmax())
            if directions[nearest, 2] > math.cos(math.radians(_NEAR)):
                fold = rotational_symmetry(orientation.material, family.normals[nearest])
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

    def rings(self, shown: Shown) -> tuple[tuple[Ring, ...], ...]:
        """Statistics of rings about the pole, of the simulated and of the measured map.

        Parameters
        ----------
        shown : Shown
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
        maps = [shown.simulated] if shown.measured is None else [shown.simulated, shown.measured]
        return tuple(ring_statistics(each, projection, fold=pole.fold) for each in maps)

    def profiles(self, shown: Shown, ends: Any, width: float) -> tuple[Rectangle, tuple[Profile, ...]]:
        """Profiles across a line on the maps.

        Parameters
        ----------
        shown : Shown
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
            `zone_line_profile` of the simulated and of the measured map.

        Raises
        ------
        ValueError
            If the line has no length, or a map has no hits along it.
        """
        (x0, y0), (x1, y1) = check_array(ends, "ends", (2, 2)).tolist()
        length = math.hypot(x1 - x0, y1 - y0)
        rectangle = Rectangle(((x0 + x1) / 2, (y0 + y1) / 2), math.degrees(math.atan2(y1 - y0, x1 - x0)), length, width)
        maps = [shown.simulated] if shown.measured is None else [shown.simulated, shown.measured]
        bins = max(2, int(width / max(shown.simulated.bin_size)))
        return rectangle, tuple(zone_line_profile(each, rectangle, bins=bins) for each in maps)

    def atoms_at(self, view: View, x: float, y: float, radius: float) -> Hits:
        """Atoms of the specimen whose ions land within a circle on the map.

        Parameters
        ----------
        view : View
            Emission and ions.
        x, y : float
            Centre of the circle [mm].
        radius : float
            Its radius [mm].

        Returns
        -------
        Hits
            Their places on the map, `positions` in the specimen [nm], `site`, `ion`, and in `extra` the charge [e] and
            field [V/nm] at the simulated voltage.
        """
        hits = self.hits(view)
        centre = check_array((x, y), "x and y", (2,))
        radius = check_number(radius, "radius", above=0, unit="mm")
        near = hits.detected & (np.hypot(hits.x - centre[0], hits.y - centre[1]) <= radius)
        rows = np.searchsorted(self.run.emissions.ions, hits.ion[near])  # type: ignore[index]
        return Hits(
            x=hits.x[near],  # type: ignore[index]
            y=hits.y[near],  # type: ignore[index]
            ion=hits.ion[near],  # type: ignore[index]
            site=self.run.site[rows],
            positions=self.run.emissions.positions[rows],
            extra={"charge": self.run.charges[rows], "field": self.run.fields[rows]},
            units={"charge": "e", "field": "V/nm"},
            source=hits.source,
        )

    # ---- text ------------------------------------------------------------------------------------------------------

    def commands(self, view: View) -> Commands:
        """Command line and Python lines that give the same maps.

        Parameters
        ----------
        view : View
            The view.

        Returns
        -------
        Commands
        """
        # a picture of `map` is neither registered nor flattened
        command = "map" if self.measured is None and not view.flattening else "explore"
        name, *options = self._run_arguments
        shell = ["apt-evap", command, name, *self._measured_arguments, *options]
        shell += self._shell_options(view, command)
        if view.flattening:
            shell += ["--flatten", repr(view.flattening)]
        if self.registration is not None:
            shell += [f"--registration={self.registration.to_text()}"]
        return Commands(shlex.join(shell), "\n".join([*self._python_hits(view), *self._python_maps(view)]))

    def selection(self, view: View, x: tuple[float, float], y: tuple[float, float]) -> Commands:
        """Command line and Python lines that select the ions within a rectangle on the map.

        Parameters
        ----------
        view : View
            The view.
        x, y : tuple of float
            Bounds of the rectangle [mm].

        Returns
        -------
        Commands
            Of the measured ions if there are any, else of the run. `hits` are the simulated ions in both cases. An
            empty command line for a measured map, which has no ions.
        """
        bounds = tuple(float(f"{value:.6g}") for value in (*sorted(x), *sorted(y)))
        box = f"--box={','.join(map(repr, bounds))}"
        window = f".window(x=({bounds[0]!r}, {bounds[1]!r}), y=({bounds[2]!r}, {bounds[3]!r}))"
        python = [*self._python_hits(view)]
        python[-1] += window
        shell = ""
        if self.measured is None:
            shell = shlex.join(["apt-evap", "map", *self._run_arguments, *self._shell_options(view, "map"), box])
        elif isinstance(self.measured, Hits):
            shell = shlex.join(["apt-evap", "map", *self._measured_arguments, box])
            python.append(f"measured = {self.measured_code}{window}")
        return Commands(shell, "\n".join(python))

    def _shell_options(self, view, command):
        options = ["--perturbation", write_perturbation(view.perturbation)]
        options += ["--bins", str(view.bins), "--smooth", repr(view.smoothing)]
        if view.ions is not None:
            # --ions of `explore` selects measured ions
            options += ["--ions" if command == "map" else "--simulated", "{},{}".format(*view.ions)]
        return options

    def _python_hits(self, view):
        lines = ["import apt_evap as ae", "", f"run = {self.run_code}"]
        hits = f"run.hits({to_python(view.perturbation)})"
        if self.registration is not None:
            r = self.registration
            lines.append(f"registration = ae.Registration({r.rotation!r}, {r.scale!r}, {r.shift!r}, {r.mirror!r})")
            hits = f"registration.hits({hits})"
        window = "" if view.ions is None else f".window(ion={view.ions!r})"
        return [*lines, f"hits = {hits}{window}"]

    def _python_maps(self, view):
        if self.measured is None:
            lines = [f"simulated = hits.map(like=run.grid({view.bins}), position_step=None)"]
            names = ["simulated"]
        else:
            lines = [
                "from apt_evap.explore.explorer import Explorer",
                f"measured = Explorer(run, {self.measured_code}, registration).bins_like({view.bins})",
                "simulated = hits.map(like=measured, position_step=None)",
            ]
            names = ["simulated", "measured"]
        flat = f".flattened({view.flattening!r})" if view.flattening else ""
        if self.measured is not None:
            lines.append(f"print(ae.similarity(simulated{flat}, measured{flat}, smoothing={view.smoothing!r}))")
        pictures = ", ".join(f"{name}{flat}.smoothed({view.smoothing!r})" for name in names)
        return [*lines, f"ae.plot.detector_maps([{pictures}])[0].figure.savefig('maps.png')"]


def _has_window(like):
    """Whether `similarity` has a window within the mask."""
    return min(like.values.shape) > 2 * WINDOW and bool(window_fits(like.mask).any())


def _starting_values(mechanism):
    return {each.name: each.value for each in controls_of(mechanism)}
