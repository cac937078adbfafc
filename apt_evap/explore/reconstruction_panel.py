"""Panel of the reconstruction: ions in the specimen with their species, the truth beside them, the field in time."""

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from html import escape
from typing import Any

import numpy as np
from bokeh.layouts import column, row
from bokeh.models import (
    Button,
    CheckboxButtonGroup,
    ColumnDataSource,
    Div,
    LinearColorMapper,
    NumericInput,
    RadioButtonGroup,
    Select,
    Slider,
    TextInput,
)
from bokeh.palettes import RdBu11, interp_palette

from apt_evap.detection.hits import Hits
from apt_evap.emission.perturbations import Perturbation
from apt_evap.explore.cloud_controls import CloudControls, words
from apt_evap.explore.explorer import Explorer
from apt_evap.explore.search_process import guarded, start_thread
from apt_evap.explore.specimen_view import SIDES, SpecimenView, pixel_color
from apt_evap.explore.widgets import color_bar, show_extent, square
from apt_evap.io.formats import read_ranges
from apt_evap.reconstruction.assumed_constants import STARTS, assumptions
from apt_evap.reconstruction.constants import run_constants
from apt_evap.reconstruction.evolving import EvolvingReconstruction
from apt_evap.reconstruction.reconstruct import SHAPES, reconstruct
from apt_evap.reconstruction.reconstructed import Reconstruction
from apt_evap.spectra.mass_ranges import Ranges
from apt_evap.spectra.mass_spectrum import Spectrum

_COLORS = ("#9aa7b4", "#ff6b6b", "#4aa3ff", "#6bd06b", "#ffb04a", "#c08bff", "#ff8fd0", "#d8d84a")
_MOST = 20_000  # spheres of a view: both turn with ten pictures a second
_FILLED = 0.8  # diameter of a sphere, in distances of neighbours if all ions were on a cubic lattice
_NARROWEST = 165  # px, of a view: two of them stand side by side
_ASSUMED = ("efficiency", "field_factor", "compression")
_BINS = 96
_SURFACE_COLOR = "#2fd6d6"  # of no species, and seen on a dark and on a light page
_SURFACE = 0.07  # nm, radius of the spheres on an isosurface, 0.2 to 0.3 nm apart: ions are seen between them
_PLACED = ("shift", "rotation")  # constants that put a reconstruction on the sites and change no distance


class ReconstructionPanel:
    """Widgets of the reconstruction."""

    def __init__(
        self,
        explorer: Explorer,
        perturbation: Callable[[], Perturbation],
        spectrum: Callable[[], Spectrum | None] | None,
        material: Callable[[], str],
        later: Callable[[Callable[[], None], int], Any],
    ) -> None:
        self._explorer, self._perturbation, self._spectrum = explorer, perturbation, spectrum
        self._material, self._later = material, later
        self.result: Reconstruction | None = None
        """The last reconstruction."""
        self.cloud: Any = None
        """Its ions and species."""
        self._make_constants()
        self._make_views()
        self.text = Div(text="", sizing_mode="stretch_width")
        self.widgets: list[Any] = [
            row(self.shape, self.solutes, self.start, styles={"flex-wrap": "wrap"}),
            row(*self.constants.values(), styles={"flex-wrap": "wrap"}),
            self.text,
            row(self.species, self.legend, self.side, styles={"flex-wrap": "wrap"}),
            self.controls.row,
            self.controls.text,
            row(self.view.figure, self.truth.figure, sizing_mode="stretch_width", styles={"flex-wrap": "wrap"}),
            column(self.depth, self.field, sizing_mode="stretch_width"),
        ]

    @property
    def has_ions(self) -> bool:
        """Whether there are ions that can be reconstructed."""
        return self._explorer.run is not None or isinstance(self._explorer.measured, Hits)

    def _make_constants(self):
        self.shape = Select(title="shape of the surface", options=list(SHAPES), value=SHAPES[0], width=120)
        self.solutes = TextInput(title="solutes, if evolving", placeholder="such as Mg, Zn", width=130)
        self.start = Button(label="reconstruct", button_type="primary", width=110, margin=(23, 5, 5, 5))
        self.start.on_click(guarded(self._compute, lambda sentence: setattr(self.text, "text", escape(sentence))))
        titles = {
            "distance": "flight length [mm]", "radius": "radius [nm]", "efficiency": "efficiency",
            "field_factor": "field factor", "compression": "compression",
        }  # fmt: skip
        self.constants = {
            name: NumericInput(
                title=title, mode="float", low=1e-3, width=105, visible=self._explorer.run is None,
                placeholder="by voltage" if name == "radius" else STARTS[name][0],
            )
            for name, title in titles.items()
        }  # fmt: skip
        self.constants["distance"].value = self._explorer.distance

    def _make_views(self):
        self.view, self.truth = SpecimenView("reconstructed"), SpecimenView("true sites")
        self.view.turn_with(self.truth)
        for view in (self.view, self.truth):
            view.bar.visible = view.figure.visible = False
            view.figure.update(min_width=_NARROWEST, styles=view.figure.styles | {"flex": f"1 1 {_NARROWEST}px"})
        self.species = CheckboxButtonGroup(labels=[], active=[], visible=False)
        self.legend = Div(text="")
        self.species.on_change("active", lambda attr, old, new: self._put_ions())
        self.controls = CloudControls(self._put_ions)
        self.side = RadioButtonGroup(labels=[*SIDES], active=None, visible=False)
        self.side.on_change("active", lambda attr, old, new: self._side_changed())
        self.depth = Slider(title="depth of the apex [nm]", start=0.0, end=1.0, step=0.1, value=0.0, visible=False)
        self.depth.on_change("value", lambda attr, old, new: self._put_field())
        self.field: Any = square(
            "field of the surface", (-1, 1, -1, 1), [], x_axis_label="x / R", y_axis_label="y / R", visible=False
        )  # fmt: skip
        self.map = ColumnDataSource({name: [] for name in ("image", "x", "y", "dw", "dh")})
        self.colors = LinearColorMapper(palette=interp_palette(RdBu11, 255), nan_color="#00000000")
        self.field.image("image", "x", "y", "dw", "dh", source=self.map, color_mapper=self.colors, level="image")
        self.field.add_layout(color_bar(self.colors, "field / mean of the sphere"), "below")

    # ---- the reconstruction ----------------------------------------------------------------------------------------

    def _compute(self):
        """Reconstruct in a thread."""
        shape = self.shape.value
        solutes = tuple(name.strip() for name in self.solutes.value.split(",") if name.strip())
        typed = {name: field.value for name, field in self.constants.items() if field.value is not None}
        self.start.disabled = True
        self.text.text = "reconstructing"

        def work():
            hits, constants, ranges = self._of_run() if self._explorer.run is not None else self._of_measured(typed)
            more = {"ranges": ranges, "solutes": solutes} if shape == "evolving" else {}
            result = reconstruct(hits, shape=shape, **more, **constants)
            cloud = result.cloud(ranges, "specimen")
            named = () if self._explorer.run is not None else [name for name in _ASSUMED if name not in typed]
            told = [] if len(result) < 2 else list(map(str, assumptions(result, named)))
            self._later(partial(self._put, result, cloud, told), 0)

        start_thread(work, lambda sentence: self._later(partial(self._failed, escape(sentence)), 0))

    def _of_run(self):
        """Ions of the run, and the constants that it knows."""
        run = self._explorer.run
        try:
            constants = run_constants(run)
        except ValueError:  # not in real units
            run = run.at_evaporation_field()
            constants = run_constants(run)
        return run.hits(self._perturbation()), constants, None

    def _of_measured(self, typed):
        """The measured ions that are shown, typed constants, and ranges of mass."""
        name = self._material()
        if not name:
            raise ValueError("choose the crystal at the left first: it gives the volume of an atom")
        if "distance" not in typed:
            raise ValueError(f"type the flight length; {STARTS['distance'][0]} {STARTS['distance'][1]}")
        ions, named = self._explorer.ions_of_file, self._spectrum() if self._spectrum is not None else None
        ranges: Ranges | None = None
        if ions.ranges is not None:
            ranges = read_ranges(ions.ranges)
        elif named is not None and any(ion.intervals for ion in named.ions):
            ranges = named.ranges()
        hits = ions.all if named is None else named.hits
        return hits, {"element": name} | typed, ranges

    def _failed(self, sentence):
        self.start.disabled, self.text.text = False, sentence

    def _put(self, result, cloud, told):
        self.start.disabled = False
        self.result, self.cloud = result, cloud
        lines = [repr(result).strip("<>")]
        if isinstance(result, EvolvingReconstruction):
            lines += [f"field of {p.name}: {p.ratio:.3f} ± {p.error:.3f} of the matrix" for p in result.phases]
        if self._explorer.run is not None and len(result) > 2:
            errors = result.errors()
            self.cloud = replace(cloud, positions=result.fitted_positions(fit=_PLACED))
            lines.append(f"beside the truth: {errors.lateral_rms:.2f} nm lateral, {errors.depth_rms:.2f} nm in depth")
        self.text.text = "<br>".join(map(escape, [*lines, *told]))
        numbers = np.bincount(cloud.species[cloud.species >= 0], minlength=len(cloud.names))
        self._order = np.argsort(-numbers, kind="stable")[: len(_COLORS)]
        labels = [cloud.names[k] for k in self._order]
        self.species.update(labels=labels, visible=True, active=list(range(len(labels)))[len(labels) > 1 :])
        self.legend.text = " ".join(
            f'<span style="color: {color}">●</span> {escape(name)}'
            for name, color in zip(labels, _COLORS, strict=False)
        )
        self.side.visible = True
        self.controls.offer(self.cloud)
        self._put_ions()
        history = result.history if isinstance(result, EvolvingReconstruction) else None
        self.depth.visible = self.field.visible = history is not None
        if history is not None:
            last = float(history.depths[-1])
            largest = max(float(np.nanmax(np.abs(history.map_at(part * last)[2] - 1))) for part in (0.25, 0.5, 0.75))
            self.colors.update(low=1 - largest, high=1 + largest)
            self.depth.update(end=last, step=last / 100, value=last / 2)
            self._put_field()

    def _put_ions(self):
        """Show the chosen species in the region, and the isosurface, of the reconstruction and of the true sites."""
        if self.cloud is None or self.result is None:
            return
        views = [("reconstructed", self.view, self.cloud)]
        if self._explorer.run is not None:
            views.append(("true sites", self.truth, replace(self.cloud, positions=self.result.hits.positions)))
        told = []
        for name, view, cloud in views:
            try:
                told.append(f"{name}: {self._put_cloud(view, cloud)}")
            except ValueError as error:
                told.append(f"{name}: {error}")
        self.controls.text.text = "<br>".join(map(escape, told)) if self.controls.used else ""

    def _put_cloud(self, view, cloud):
        """Show a cloud; what is in the region, in words."""
        size = np.ptp(cloud.positions, axis=0)
        radius = max(_FILLED / 2 * float(np.cbrt(size.prod() / len(cloud))), 0.05)
        region = self.controls.region()
        try:
            surface, problem = self.controls.surface(cloud), ""
        except ValueError as error:
            surface, problem = np.zeros((0, 3)), f"; {error}"
        if region is not None:
            cloud, surface = cloud.select(region), surface[region.distance(surface) <= 0]
        color_of = np.zeros(len(cloud.names), np.int32)
        chosen = np.zeros(len(cloud.names) + 1, bool)  # the last one is of ions in no range
        for number, species in enumerate(self._order):
            color_of[species] = pixel_color(_COLORS[number])
            chosen[species] = number in self.species.active
        ions = np.flatnonzero(chosen[cloud.species])
        ions, surface = (rows[:: max(1, -(-len(rows) // _MOST))] for rows in (ions, surface))
        if len(ions) + len(surface):
            turquoise = np.full(len(surface), pixel_color(_SURFACE_COLOR), np.int32)
            radii = np.r_[np.full(len(ions), radius), np.full(len(surface), _SURFACE)]
            colors = np.r_[color_of[cloud.species[ions]], turquoise]
            view.put_spheres(np.concatenate([cloud.positions[ions], surface]), colors, radii)
            view.figure.visible = True
        return words(cloud) + problem

    def _put_field(self):
        history = self.result.history if isinstance(self.result, EvolvingReconstruction) else None
        if history is None:
            return
        edges, _, field = history.map_at(self.depth.value, _BINS)
        low, size = float(edges[0]), float(edges[-1] - edges[0])
        self.map.data = {"image": [field.astype(np.float32)], "x": [low], "y": [low], "dw": [size], "dh": [size]}
        self.field.title.text = f"field of the surface at a depth of {self.depth.value:.1f} nm"
        show_extent(self.field, (low, -low, low, -low))

    def _side_changed(self):
        if self.side.active is not None:
            self.view.set_viewpoint(self.side.labels[self.side.active])
            self.truth.set_viewpoint(self.side.labels[self.side.active])
            self.side.active = None
