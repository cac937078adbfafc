"""Reconstruction by a surface that follows its ions: recession from the voltage and the phases, fields by fixed point.

The steps of `follow_surface`: the cap, a pass with the recession from the ring, the phases at the positions of this
pass, then passes with the recession from voltage and phases, or the mean of both, each with the evaporation fields that
the pass before has found. Without a phase, one pass with the recession of the cap.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, fields, replace
from typing import Any, ClassVar, NamedTuple

import numpy as np
import scipy
from numpy.typing import ArrayLike

from apt_evap._common.types import Booleans, Floats
from apt_evap._common.validation import check_array, check_number, check_sequence, did_you_mean
from apt_evap.detection.hits import Hits, MassRanges
from apt_evap.reconstruction.beyond_view import FLAT_GATE, Continuation, Feature, continued
from apt_evap.reconstruction.cap_geometry import voltages_of
from apt_evap.reconstruction.evolving_surface import DEPTH_WINDOW, EvolvingSurface, IonSequence, SurfacePass, mean_pass
from apt_evap.reconstruction.found_region import found_tip
from apt_evap.reconstruction.local_composition import (
    CONTRAST_GATE,
    SoluteContrast,
    contents,
    core_of,
    local_composition,
    local_share,
    noise_free_slopes,
    solute_contrast,
)
from apt_evap.reconstruction.phase_bursts import BURST_GATE, rate_variation
from apt_evap.reconstruction.reconstructed import Reconstruction, cap_reconstruction
from apt_evap.reconstruction.reconstruction_settings import ReconstructionSettings, slope_of_shank
from apt_evap.reconstruction.twin_correction import TwinErrors
from apt_evap.reconstruction.voltage_course import smoothed, without_jumps
from apt_evap.simulation.run import Run
from apt_evap.specimen.materials import Material, as_material
from apt_evap.specimen.tip import Tip

FEWEST_IONS = 2000
"""Fewest ions that a surface is integrated from: 20 in each step of a specimen that recedes by R / 1.3."""
WIDEST_VIEW = 60.0
"""Largest half angle of the field of view [degrees]: beyond, the response of a sphere does not describe a specimen."""

SHALLOWEST = 0.07
"""Least depth over the radius for phases: the voltage is looked at from 0.065 on, as the first shape is not known."""

EMISSION_GATE = 0.33
"""Largest contrast of the density of the matrix on the detector: 0.16 to 0.29 for aluminium at rest or as it rolls,
0.34 to 0.47 if all ions roll, and then the surface is no better than the cap. No sign of rolling alone: W, Mg and Pt at
rest have 0.35 or 0.36 in views of 20 degrees."""
VOLTAGE_GATE = 0.02
"""Largest change of the voltage about its trend without a phase: 0.005 to 0.007 for seven pure crystals, 0.020 for the
planes of Fe [001], 0.007 for spheres, 0.033 for a layer of 1.15 times the field across the whole specimen."""

VOLTAGE_ERROR = 0.017
"""Relative error of V F = F_evap: RMS of V F / F_evap - 1 in the matrix of a pure specimen and of three with spheres,
0.007 to 0.026, where the flux at the rim tells the recession without it."""

CRYSTAL_DOUBT = 2.0
"""Part of the difference of two measures of the recession that is in doubt, over that of the flux at the rim to 1: half
where it is three quarters. In views of 20 degrees 0.21 / 0.49 and 0.42 / 0.72 of the depths are within one and two
standard deviations without (sphere of 0.8, layer of 1.15, seed 1, which chose it), 0.44 / 0.98 and 0.74 / 0.97 with it;
in 25 degrees 0.71 / 0.96 and 0.66 / 0.96, and 0.73 / 0.97 and 0.79 / 0.98."""

_WINDOW = 0.65  # of the radius: depth in which the trend is a straight line
_FIRST_SHAPE = 0.065  # of the radius
_PASSES = 7  # most of them, with voltage and phases
_SETTLED = 0.002  # change of the fields in the last pass: a fifth of their smallest stated error
_STEEPEST = 0.6  # slope of the fields that a pass gives over those it used: a step grows by 2.5 at most
_ION_LIMIT = 60_000  # in these passes; of more ions, every n-th
_SPIN_UP = 0.05  # of the ions, from which nothing is measured: the first shape is not known
_CLEAN = 0.02  # of the ions of a block: largest share of phases in a stretch of matrix
_CLEAN_BLOCKS = 100
_ALLOWED = 1.5  # standard deviations of its noise, for a stretch without gaps
_FIELD_LIMITS = 0.5, 2.0  # of a phase relative to the matrix
_FIELD_BIAS = 0.15  # of the difference to the matrix: by how much fields are found closer to 1, or farther
_ION_LIMITS = 0.4, 2.5
_CORE = 25  # neighbours for the core of a phase
_DENSITY_WIDTH = math.radians(3.0)  # of the Gaussian of the density on the detector
_FOREIGN = 0.1  # of the ions of a cell: most that may be of another phase
_DENSITY_BINS = 61
_DENSITY_IONS = 5000  # of a block: its noise is 0.07
_CONSTANT = 1e-6  # relative spread of a voltage that does not change


@dataclass(frozen=True)
class PhaseField:
    """Evaporation field of a phase, found by the reconstruction.

    Parameters
    ----------
    name : str
        Label of the phase, or the solute that it is enriched in.
    ratio, error : float
        Evaporation field relative to that of the matrix, and its standard error; NaN if none was found.
    ions : int
        Ions that belong to the phase.
    matrix, content : float
        Fraction of the solute in the matrix and in the phase; 0 and 1 for labels.
    contrast : float
        Contrast of the solute over its noise; NaN for labels.
    """

    name: str
    ratio: float
    error: float
    ions: int
    matrix: float
    content: float
    contrast: float


@dataclass(frozen=True, eq=False)
class SurfaceHistory:
    """Shape and field of the surface through time, and what was measured; k steps.

    Parameters
    ----------
    surface : EvolvingSurface
        Grid and transform.
    run : SurfacePass
        The last pass.
    voltage : ndarray
        Mean voltage of each step relative to that of the matrix on a sphere, shape (k,); NaN without voltages.
    """

    surface: EvolvingSurface = field(repr=False)
    run: SurfacePass = field(repr=False)
    voltage: Floats = field(repr=False)

    @property
    def depths(self) -> Floats:
        """Depth of the apex of the sphere at the beginning of each step [nm], shape (k,)."""
        return self.run.steps.depths

    @property
    def radii(self) -> Floats:
        """Radius of the sphere at the beginning of each step [nm], shape (k,)."""
        ions = self.surface.ions
        return ions.radius + ions.growth * self.depths

    @property
    def recession(self) -> Floats:
        """Recession of the sphere over that of a cap that keeps its shape, shape (k,)."""
        return self.run.steps.recession

    @property
    def model_voltage(self) -> Floats:
        """Voltage at which the surface of each step evaporates, relative to the matrix on a sphere, shape (k,)."""
        return self.voltage / self.run.steps.mean_field

    @property
    def shapes(self) -> Any:
        """Coefficients of the height above the sphere [nm] of each step, shape (k, m, l), see `SphericalTransform`."""
        return self.run.steps.shapes

    def step_at(self, depth: float) -> int:
        """Number of the step at a depth of the apex [nm]."""
        wanted = check_number(depth, "depth", unit="nm")
        return int(np.clip(np.searchsorted(self.depths, wanted, side="right") - 1, 0, len(self.depths) - 1))

    def map_at(self, depth: float, bins: int = 64) -> tuple[Floats, Floats, Floats]:
        """Height and field of the surface in the field of view, at a depth of the apex.

        Parameters
        ----------
        depth : float
            Depth of the apex of the sphere [nm].
        bins : int
            Number of cells along the diameter.

        Returns
        -------
        edges : ndarray, shape (bins + 1,)
            Edges of the cells in x / R and y / R.
        height : ndarray, shape (bins, bins)
            Height above the sphere [nm], indexed [y, x]; NaN outside the field of view.
        field : ndarray, shape (bins, bins)
            Field relative to the mean of the sphere.
        """
        surface, step = self.surface, self.step_at(depth)
        coefficients = self.shapes[step]
        degrees = surface.transform.degrees
        grids = surface.transform.synthesis(np.stack([coefficients, (degrees - 1) * coefficients / self.radii[step]]))
        rim = math.sin(surface.ions.rim)
        edges = np.linspace(-rim, rim, bins + 1)
        x, y = np.meshgrid((edges[1:] + edges[:-1]) / 2, (edges[1:] + edges[:-1]) / 2)
        inside = x**2 + y**2 <= rim**2
        directions = np.stack([x, y, np.sqrt(np.where(inside, 1 - x**2 - y**2, 1.0))], axis=-1).reshape(-1, 3)
        height, excess = surface.at_directions(grids, directions).T.reshape(2, bins, bins)
        return edges, np.where(inside, height, np.nan), np.where(inside, 1 + excess, np.nan)


@dataclass(frozen=True, eq=False, repr=False)
class EvolvingReconstruction(Reconstruction):
    """Ions reconstructed by a surface that follows them; made by ``reconstruct(..., shape="evolving")``.

    Parameters
    ----------
    positions, hits, radii, settings, geometry, shifts, covariances
        As for `Reconstruction`.
    history : SurfaceHistory or None
        Shape and field of the surface through time; None if the cap was used.
    phases : tuple of PhaseField
        Evaporation fields that were found.
    continuations : tuple of Continuation
        How each phase was continued beyond the field of view.
    verdict : str
        What the surface was followed by, or why the cap was used, with the number that decided it.
    apex_depths : ndarray
        Depth of the apex of the sphere at each ion [nm], shape (n,).
    ion_fields : ndarray
        Evaporation field of each ion by its phase or surroundings relative to that of the matrix, shape (n,).
    """

    history: SurfaceHistory | None = None
    phases: tuple[PhaseField, ...] = ()
    continuations: tuple[Continuation, ...] = ()
    verdict: str = ""
    apex_depths: Floats | None = None
    ion_fields: Floats | None = None
    _followed: Any = field(default=None, repr=False)
    """What `again` needs: what was measured, and what was kept fixed."""
    _cap_radii: Floats | None = field(default=None, repr=False)
    """Radii of the cap [nm], for `cap_positions`."""
    twin_errors: TwinErrors | None = field(default=None, repr=False)
    """Errors of the twin by whose means the positions are corrected; None without one, or if it was refused."""

    _has_free_projection: ClassVar[bool] = False

    def depths_of(self, ions: Any) -> Floats:
        """Depth of the apex of the sphere at the evaporation of some ions [nm]."""
        return super().depths_of(ions) if self.apex_depths is None else self.apex_depths[ions]

    @property
    def cap_positions(self) -> Floats:
        """Positions of the same ions by the cap, x, y and depth [nm], shape (n, 3)."""
        radii = self._cap_radii if self._cap_radii is not None else self.radii
        return self.geometry.positions(self.hits, radii)

    @property
    def sequence(self) -> IonSequence:
        """Ions of the passes in which the fields were found: every n-th of many."""
        return self._passes()[0].ions  # type: ignore[no-any-return]

    @property
    def followed_by(self) -> str:
        """What the recession follows from: "volume" without a phase, "ring", "surface" or "both"; "cap" if nothing."""
        return "cap" if self._followed is None else self._followed[1].way

    @property
    def found_features(self) -> list[tuple[PhaseField, Feature]]:
        """Each of `phases` whose contrast was seen, and its ions of `sequence`."""
        seen = [one for one in self.phases if not one.contrast < CONTRAST_GATE]
        return list(zip(seen, self._passes()[1].features, strict=True))

    def _passes(self):
        """Measurement and results of the passes; ValueError for ions that are left to the cap."""
        if self._followed is None:
            raise ValueError(f"reconstruction must have a surface that was followed, got {self.verdict!r}")
        return self._followed

    def again(
        self,
        ions: IonSequence,
        rows: slice = slice(None),
        *,
        changes: ArrayLike = 0.0,
        voltage: float = 1.0,
        by: str | None = None,
    ) -> Floats:
        """Positions out of the specimen [nm] of some ions of `sequence`, perhaps changed, with the same fields.

        Parameters
        ----------
        ions : IonSequence
            The ions.
        rows : slice
            Which of those of `sequence` they are.
        changes : array_like
            What is added to the relative evaporation fields of `found_features`.
        voltage : float
            Factor of the voltages.
        by : str, optional
            Recession as for `EvolvingSurface.integrate`; by default that of this reconstruction.

        Returns
        -------
        ndarray, shape (n, 3)
        """
        measured, fixed = self._passes()
        surface = EvolvingSurface(ions)
        by = by or fixed.way
        if by not in ("surface", "both"):
            return surface.integrate(recession=by, rim=fixed.flux).positions
        depths = measured.ions.depths[1:]
        voltages = (voltage * measured.voltages / (fixed.trend[0] + fixed.trend[1] * depths) / fixed.level)[rows]
        added = np.broadcast_to(np.asarray(changes, np.float64), len(fixed.features))
        features = [
            replace(one, membership=one.membership[rows], own=one.own[rows], ratio=one.ratio + change)
            for one, change in zip(fixed.features, added, strict=True)
        ]
        fields = fixed.fields[rows] + sum(change * one.membership for one, change in zip(features, added, strict=True))
        places = fixed.positions[rows] if features else ions.directions  # of no phase nothing is continued
        for _ in range(2):  # the phases where these ions were found, then where those of the changed sequence are
            outside, ways = continued(features, places, ions.in_ring)
            places = surface.integrate(voltages, fields, outside, "surface").positions
            if all(one.way == "none" for one in ways):
                break
        return (places + surface.integrate(rim=fixed.flux).positions) / 2 if by == "both" else places

    def recession_changes(self) -> list[Floats]:
        """What the recession of the sphere is not sure about: changes of the positions of `sequence` [nm].

        By `VOLTAGE_ERROR`, and by the evaporation field of each phase, one standard error of it; without phases at the
        rim of the field of view by the voltage alone, which is one of two measures, or tells of it a second time. Where
        the matrix has less of the flux at the rim, by its crystal, also by the other measure, the flux without this
        correction or, with phases at the rim, the volume: times `CRYSTAL_DOUBT` and the part that it lacks.
        """
        ions, (measured, fixed) = self.sequence, self._passes()
        usual = self.again(ions)
        by_crystal = CRYSTAL_DOUBT * (1 - fixed.flux)
        if fixed.way == "ring":
            return [by_crystal * (usual - EvolvingSurface(ions).integrate().positions)] if by_crystal else []
        known = fixed.way == "volume" or any(one.error == one.error for one in self.phases)
        if measured.voltages is None or not known:
            return []
        if self.followed_by == "volume":
            level = float(np.mean(measured.voltages * EvolvingSurface(ions).integrate(recession="volume").fields))
            return [self.again(ions, voltage=1 / level, by="surface") - usual]
        if fixed.way == "both":
            change = self.again(ions, by="surface") - usual
            if not by_crystal:
                return [change]
            # what is followed is the mean of the voltage and of the flux over that of the crystal
            return [change, by_crystal * (usual - change - EvolvingSurface(ions).integrate().positions)]
        errors = np.diag(np.nan_to_num([one.error for one, _ in self.found_features]))
        changes = [self.again(ions, voltage=1 + VOLTAGE_ERROR) - usual]
        changes += [self.again(ions, changes=error) - usual for error in errors]
        if by_crystal:
            changes.append(by_crystal * (self.again(ions, by="volume") - usual))
        return changes

    def specimen(
        self,
        material: Material | str | None = None,
        *,
        axis: Sequence[float] = (0, 0, 1),
        radius: float | None = None,
        phases: bool = True,
    ) -> Tip:
        """Specimen with the phases where they were found, and the evaporation fields that were found.

        Parameters
        ----------
        material : Material or str, optional
            Crystal of matrix and phases; by default the element of the reconstruction.
        axis : sequence of float
            Crystal direction along the axis.
        radius : float, optional
            Radius of the apex [nm], for a specimen of the same shape and another size; by default the first radius of
            the reconstruction.
        phases : bool
            Whether it has the phases; False for the matrix alone.

        Returns
        -------
        Tip

        Raises
        ------
        ValueError
            If the reconstruction has found no evaporation fields, or no material is known.
        """
        if self._followed is None or not np.isfinite(self._followed[1].errors).any():
            raise ValueError(
                f"the reconstruction must have found evaporation fields by voltage and phases, got {self.verdict!r}"
            )
        chosen = self.settings.element if material is None else material
        if chosen is None:
            raise ValueError("material must be given for a reconstruction without element, got None for both")
        ions = self.sequence
        every = -(-len(self) // len(ions.directions))
        positions = self.specimen_positions[::every] + np.array([0.0, 0.0, ions.radius])
        size = ions.radius if radius is None else check_number(radius, "radius", above=0, unit="nm")
        found = (
            [(one.name, replace(feature, ratio=one.ratio)) for one, feature in self.found_features] if phases else []
        )
        return found_tip(positions, ions, found, as_material(chosen), axis, size)

    def __repr__(self) -> str:
        known = [phase for phase in self.phases if phase.error == phase.error]
        fields = "".join(f"; {phase.name} {phase.ratio:.3f} ± {phase.error:.3f}" for phase in known)
        return f"{super().__repr__()[:-1]}; {self.verdict}{fields}>"


class _Measured(NamedTuple):
    """What the surface follows: ions, their voltage, and labels or solutes."""

    ions: IonSequence
    voltages: Floats | None  # relative
    names: tuple[str, ...]
    own: tuple[Booleans, ...]  # ions of each label or solute
    has_labels: bool
    jumps: int  # of the voltage that were taken out
    atomic_volume: float  # nm^3

    def part(self, first: int, every: int) -> _Measured:
        """Every n-th ion."""
        rows = slice(first, None, every)
        return self._replace(
            ions=self.ions.part(first, every),
            voltages=None if self.voltages is None else self.voltages[rows],
            own=tuple(own[rows] for own in self.own),
        )


class _Fixed(NamedTuple):
    """Result of the passes over part of the ions."""

    way: str  # recession of the last pass
    level: float  # of the voltage
    trend: Floats  # of the voltage over the nominal depth: value at 0, slope
    features: list[Feature]
    contrasts: list[SoluteContrast]
    fields: Floats  # of each ion
    positions: Floats  # of the last pass but one, from which the phases are continued
    ways: list[Continuation]
    ratios: Floats
    errors: Floats
    flux: float = 1.0  # at the rim over that of the whole view, in the matrix, if it is less: by the crystal
    bursts: float = 0.0  # variation of the rate at which ions of the phases leave


def follow_surface(
    hits: Hits,
    settings: ReconstructionSettings,
    ranges: MassRanges | None = None,
    solutes: Sequence[str] = (),
    labels: ArrayLike | None = None,
    twin: Run | None = None,
) -> EvolvingReconstruction:
    """Reconstruct ions by a surface that follows them, with resolved settings, see `reconstruct`."""
    if settings.protocol != "cap":
        raise ValueError(f'protocol must be "cap" with shape="evolving", got {settings.protocol!r}')
    cap, rows = cap_reconstruction(hits, settings)
    _check_sequence(cap.hits)
    names, own = _phases_of(cap.hits, rows, len(hits), ranges, solutes, labels)
    rim = float(np.mean(cap.geometry.rim_angles(cap.hits, cap.radii)))
    if len(cap) < FEWEST_IONS:
        return _as_cap(cap, f"{len(cap):,} ions, fewer than {FEWEST_IONS:,}")
    if math.degrees(rim) > WIDEST_VIEW:
        return _as_cap(cap, f"a half angle of {math.degrees(rim):.0f} degrees on the cap, above {WIDEST_VIEW:.0f}")
    places, angles = cap.geometry.places(cap.hits, cap.radii)
    voltages, factors, jumps, why = _relative_voltages(cap.hits, cap)
    radius, growth = _growth_of(cap, factors if jumps else 1.0)
    way = "ring" if names else "volume"
    twin_errors = None if twin is None else TwinErrors.of(twin, rim, way)  # a wrong one is refused before the passes
    ions = IonSequence(np.column_stack([places, np.cos(angles)]), cap.geometry.volume, rim, radius, growth)
    atom: float = settings.atomic_volume  # type: ignore[assignment]
    measured = _Measured(ions, voltages, names, own, labels is not None, jumps, atom)
    every = -(-len(cap) // _ION_LIMIT)
    thinned = measured.part(0, every) if every > 1 else measured
    fixed = _fixed_point(thinned)
    if isinstance(fixed, str):
        return _as_cap(cap, fixed + (f" ({why})" if why else ""))
    found = _placed(cap, measured, fixed, every, why, thinned)
    if twin is None or twin_errors is None:
        return found
    if names and found.followed_by == "volume":
        twin_errors = TwinErrors.of(twin, rim, "volume")
    return _corrected(found, twin_errors, ions.directions)


def _check_sequence(hits):
    """Raise an error if a column shows that the ions are not in the sequence of evaporation."""
    for name in ("ion", "pulse_id"):
        numbers = getattr(hits, name)
        if numbers is not None and (falls := np.flatnonzero(np.diff(numbers) < 0)).size:
            row = int(falls[0]) + 1
            raise ValueError(
                f"hits must be in the sequence of evaporation, got {name} {numbers[row]} after {numbers[row - 1]} at "
                f"ion {row}"
            )


def _phases_of(hits, rows, n, ranges, solutes, labels):
    """Names of the labels but the matrix, or of the solutes, and which ions are of each."""
    if labels is not None and len(solutes):
        raise ValueError("labels and solutes exclude each other, got both")
    if labels is not None:
        chosen = check_array(labels, "labels", (n,), dtype=np.int64)[rows]
        kinds, counts = np.unique(chosen, return_counts=True)
        if len(kinds) < 2:
            raise ValueError(f"labels must mark at least two phases, got {kinds[0]} for all {len(chosen):,} ions")
        others = [kind for kind in kinds if kind != kinds[counts.argmax()]]
        return tuple(f"label {kind}" for kind in others), tuple(chosen == kind for kind in others)
    names = tuple(check_sequence(solutes, "solutes", "names of species"))
    if not names:
        return (), ()
    if ranges is not None:
        species, numbers = list(ranges.species_names), ranges.species(hits)
        own = {name: numbers == index for index, name in enumerate(species)}
    elif "element" in hits.extra:
        elements = hits.extra["element"].astype(str)
        own = {str(name): elements == name for name in np.unique(elements)}
    else:
        raise ValueError(f"solutes={names} need ranges, or the elements of simulated ions, got neither")
    for name in names:
        if name not in own:
            raise ValueError(f"solutes must be species of the ranges, got {name!r}{did_you_mean(name, list(own))}")
        if not own[name].any():
            raise ValueError(f"solutes must be among the ions, got {name!r} of which there is none")
    return names, tuple(own[name] for name in names)


def _density_contrast(ions, others=None):
    """Contrast of the density of the matrix on the detector, without the noise of the counts.

    A precipitate changes the density of its cells and blocks, rolling that of all. Cells with other ions are left out,
    and the median of blocks of the sequence is taken; with no phase known, the most even block.
    """
    rim = math.sin(ions.rim)  # an even flux is even in x / R and y / R
    edges = np.linspace(-1.02 * rim, 1.02 * rim, _DENSITY_BINS + 1)
    centres = (edges[1:] + edges[:-1]) / 2
    inside = centres[:, None] ** 2 + centres**2 < rim**2
    width = _DENSITY_WIDTH / (edges[1] - edges[0])
    seen = np.maximum(scipy.ndimage.gaussian_filter(inside.astype(float), width), 0.05)
    n = len(ions.directions)
    contrasts = []
    for rows in np.array_split(np.arange(n), int(np.clip(n // _DENSITY_IONS, 1, 5))):
        places = ions.directions[rows, :2]
        counts = np.histogram2d(*places.T, bins=(edges, edges))[0]
        smooth, cells = scipy.ndimage.gaussian_filter(counts, width), inside
        if others is not None:
            foreign = np.histogram2d(*places[others[rows]].T, bins=(edges, edges))[0]
            cells = inside & (scipy.ndimage.gaussian_filter(foreign, width) < _FOREIGN * smooth)
            if np.count_nonzero(cells) < 0.25 * np.count_nonzero(inside):
                continue
        density = (smooth / seen)[cells]
        noise = np.count_nonzero(inside) / max(counts.sum(), 1) / (4 * math.pi * width**2)
        contrasts.append(math.sqrt(max(0.0, density.var() / max(density.mean(), 1e-12) ** 2 - noise)))
    if others is None:
        return min(contrasts)
    return float(np.median(contrasts)) if contrasts else _density_contrast(ions)


def _as_cap(cap, reason):
    """The cap, and why it was used."""
    columns = {part.name: getattr(cap, part.name) for part in fields(Reconstruction)}
    return EvolvingReconstruction(**columns, verdict=f"cap: {reason}")


def _growth_of(cap, factors):
    """Radius of the cap at the first ion [nm], and its increase per depth; factors take out jumps of the voltage."""
    settings = cap.settings
    if settings.mode == "shank":
        return settings.initial_radius, slope_of_shank(settings.shank_angle)
    radii, depths = cap.radii * (factors if settings.mode == "voltage" else 1.0), cap.depths
    if np.ptp(radii) == 0:
        return float(radii[0]), 0.0
    # a straight line through the medians of 40 sections: a phase of another field is not a change of the radius
    sections = [part for part in np.array_split(np.arange(len(radii)), 40) if len(part)]
    at, middle = (np.array([np.median(values[part]) for part in sections]) for values in (depths, radii))
    run, rise = at[:, None] - at, middle[:, None] - middle  # by Theil and Sen; SciPy's statistics load for 0.8 s
    slope = np.median(rise[run > 0] / run[run > 0])
    start = np.median(middle) - slope * np.median(at)
    growth = float(np.clip(slope, 0.0, 1.0))
    if growth == 0:
        return float(np.median(radii)), 0.0
    return float(max(start + slope * depths[0], 1e-3)), growth


def _relative_voltages(hits, cap):
    """Voltage of each ion over its mean, averaged over a depth, what was taken out, their number; or None and why."""
    if hits.voltage is None:
        return None, None, 0, "no voltage"
    total = voltages_of(hits)
    if np.ptp(total) <= _CONSTANT * total.mean():
        return None, None, 0, f"a constant voltage of {total[0]:g} V"
    if total.min() <= 0:
        row = int(total.argmin())
        raise ValueError(f'voltage must be > 0 V with shape="evolving", got {total[row]:g} V at ion {row}')
    width = DEPTH_WINDOW * float(np.median(cap.radii)) / max(float(np.ptp(cap.depths)), 1e-9) * len(total)
    factors, jumps = without_jumps(total, width)
    smooth = smoothed(total * factors, width)
    return smooth / smooth.mean(), factors, jumps, ""


def _fixed_point(measured):
    """Passes until the evaporation fields are found, or why the cap must be used."""
    ions, own = measured.ions, measured.own
    n = len(ions.directions)
    surface = EvolvingSurface(ions)
    ring = surface.integrate() if own else None
    places = None if ring is None else ring.positions
    halves = np.random.default_rng(0).integers(0, 2, n).astype(bool)
    contrasts: list[SoluteContrast] = []
    if not measured.has_labels:
        contrasts = [solute_contrast(places, one, halves, ions.volume) for one in own]
    seen = [k for k in range(len(own)) if measured.has_labels or contrasts[k].is_seen]
    ratios = np.ones(len(own))
    nothing = _Fixed(
        way="ring" if seen else "volume", level=1.0, trend=np.array([1.0, 0.0]), features=[], contrasts=contrasts,
        fields=np.ones(n), positions=places, ways=[], ratios=ratios, errors=np.full(len(own), np.nan),
    )  # fmt: skip
    _, features = _features(measured, seen, contrasts, halves, places, ratios)
    others = np.any([one.members for one in features], axis=0) if features else None
    contrast = _density_contrast(ions, others)
    if contrast > EMISSION_GATE:
        return f"the density of the matrix on the detector has a contrast of {contrast:.2f}, as if ions roll"
    depth = ions.depths[-1]
    if depth < SHALLOWEST * ions.radius and (not seen or measured.voltages is not None):
        why = f"a depth of {depth:.3g} nm is less than {SHALLOWEST:g} of the radius: no field follows from it"
        return why if seen else nothing
    if not seen:
        swing = _voltage_swing(measured)
        if swing > VOLTAGE_GATE:
            return (
                f"the voltage changes by {swing:.1%} about its trend, as by a phase at the rim of the field of view, "
                "and neither labels nor solutes show one"
            )
        return nothing
    bursts = rate_variation(others, ions.depths[1:], measured.atomic_volume, _FIRST_SHAPE * ions.radius)
    if bursts > BURST_GATE:
        return nothing._replace(way="volume", features=features, bursts=bursts)
    _, ways = continued(features, places, ions.in_ring)
    reaches = [way for way in ways if way.way != "none"]
    # Where the matrix has less at the rim, it is by its crystal: 0.87 to 0.92 in 25 degrees about Al [012]. More, up to
    # 1.41 about other poles, is left as it is: depths of spheres have 0.148 nm by the mean, and 0.218 if divided by it
    flux = min(1.0, _matrix_flux(ions, features))
    if measured.voltages is None:
        if reaches:
            worst = max(way.share for way in reaches)
            return f"a phase reaches the rim of the field of view, {worst:.2f} of the ring, and the voltage is needed"
        return nothing._replace(way="ring", flux=flux, features=features, ways=ways)
    # On a shank the voltage without its slow trend, by the matrix in a pass without voltage: it is not proportional to
    # the radius. With a constant radius a trend would be one of the phases: depth errors 0.138 in place of 0.122 nm.
    depths, trend = ions.depths[1:], nothing.trend
    if ions.growth > 0:
        trend = _trend(measured.voltages * ring.fields, _matrix(features), depths)
    voltages = measured.voltages / (trend[0] + trend[1] * depths)
    level = _level(voltages, ring.fields, features, ions)
    start = nothing._replace(trend=trend, level=level, features=features, flux=flux)
    fixed = _found_by_passes(measured, start, surface, ring, voltages, seen, halves)
    if rough := [way for way in fixed.ways if way.way == "ring"]:
        flatness = max(way.flatness for way in rough)
        share = max(way.share for way in rough)
        # above one half, a convention: a sphere of 1.2 in 20 degrees is 0.61 to 0.71 of the ring, and by the cap 0.57
        # times as thick; two small spheres are 0.08 of it, 1.03 to 1.05 and 0.90 to 0.91 times
        narrow = "; the view is too narrow for it, and its thickness by the cap is not to be trusted"
        return (
            f"a phase reaches the rim of the field of view, {share:.2f} of the ring, "
            f"and is not flat: its thickness is {flatness:.2f} of its extent, above {FLAT_GATE:g}"
            f"{narrow if share > 0.5 else ''}"
        )
    return fixed


def _found_by_passes(measured, start, surface, ring, voltages, seen, halves):
    """The fixed point of fields and positions, from a pass with the recession from the ring."""
    ions, level, ratios, features, found = measured.ions, start.level, start.ratios, start.features, ring
    errors = np.zeros(len(ratios))
    used = given = None
    by_rim = ring if start.flux == 1 else surface.integrate(rim=start.flux)
    for _ in range(_PASSES):
        features = [replace(one, ratio=float(ratios[k])) for one, k in zip(features, seen, strict=True)]
        outside, ways = continued(features, found.positions, ions.in_ring)
        before, thresholds = found.positions, _ion_fields(features)
        # With the phases inside, the mean of both measures, which err apart. RMS of the depth errors by the voltage, by
        # the flux, by that without the crystal's, and by the mean, about Al [012]: 0.125, 0.113, 0.136 and 0.114 nm in
        # 25 views of 30 degrees, 0.154, 0.237, 0.170 and 0.113 in 19 of 25
        by = "both" if all(one.way == "none" for one in ways) else "surface"
        found = surface.integrate(voltages / level, thresholds, outside, "surface")
        if by == "both":
            found = mean_pass(found, by_rim)
        values = found.fields * voltages / level
        compositions, features = _features(measured, seen, start.contrasts, halves, found.positions, ratios)
        level = _level(voltages, found.fields, features, ions)
        new, errors[seen] = _found_fields(measured, features, compositions, values, found.positions)
        # of a phase whose ions are all at the beginning no field is known
        last, used, given = (used, given), ratios[seen], np.clip(np.nan_to_num(new, nan=1.0), *_FIELD_LIMITS)
        if last[0] is not None and np.abs(given - used).max() < _SETTLED:
            break
        ratios = ratios.copy()
        ratios[seen] = np.clip(_extrapolated(used, given, *last), *_FIELD_LIMITS)
    ratios = ratios.copy()
    ratios[seen] = np.where(np.isnan(new), np.nan, given)
    return start._replace(
        way=by, level=level, features=features, fields=thresholds, positions=before, ways=ways, ratios=ratios,
        errors=errors,
    )  # fmt: skip


def _extrapolated(used, given, used_before, given_before):
    """Fields that would be given as they are used, by the straight line through two passes, for each phase."""
    if used_before is None:
        return given
    change = used - used_before
    slopes = np.where(change == 0, 0.0, (given - given_before) / np.where(change == 0, 1.0, change))
    return used + (given - used) / (1 - np.clip(slopes, 0.0, _STEEPEST))


def _voltage_swing(measured):
    """Largest range of the voltage about a straight line in windows of the depth, without the first shape."""
    if measured.voltages is None:
        return 0.0
    depths = measured.ions.depths[1:] / measured.ions.radius
    later = depths > _FIRST_SHAPE
    depths, voltages = depths[later], measured.voltages[later]
    swings = [0.0]
    for window in np.array_split(np.arange(len(depths)), max(1, round(float(np.ptp(depths)) / _WINDOW))):
        line = np.polyval(np.polyfit(depths[window], voltages[window], 1), depths[window])
        low, high = np.quantile(voltages[window] / line, (0.01, 0.99))
        swings.append(float(high - low))
    return max(swings)


def _features(measured, seen, contrasts, halves, positions, ratios):
    """Phases at the positions of a pass, and the compositions they follow from."""
    compositions, features = [], []
    for k in seen:
        own = measured.own[k]
        if measured.has_labels:
            features.append(Feature(own.astype(np.float64), own, 0.0, 1.0, float(ratios[k])))
            continue
        neighbours = contrasts[k].neighbours
        found = local_composition(positions, own, halves, neighbours, measured.ions.volume)
        matrix, content, error = contents(positions, own, halves, found, neighbours, measured.ions.volume)
        compositions.append(found)
        membership = (found.all - matrix) / (content - matrix)
        features.append(Feature(membership, own, matrix, content, float(ratios[k]), error, neighbours))
    return compositions, features


def _ion_fields(features):
    """Evaporation field of each ion relative to that of the matrix, shape (n,)."""
    return np.clip(1 + sum((one.ratio - 1) * one.membership for one in features), *_ION_LIMITS)


def _matrix(features):
    """How far each ion belongs to the matrix, without those of the first shape, shape (n,)."""
    weights = np.clip(1 - sum(np.clip(one.membership, 0, 1) for one in features), 0, 1)
    weights[: int(_SPIN_UP * len(weights))] = 0
    return weights


def _trend(values, weights, depths):
    """Value at depth 0 and slope of a straight line through weighted values."""
    if weights.sum() < FEWEST_IONS / 10:
        return np.array([1.0, 0.0])
    slope, start = np.polyfit(depths, values, 1, w=np.sqrt(weights))
    return np.array([start, slope])


def _clean_blocks(features, ions, allowed):
    """Block of each ion, and which blocks of the sequence are of matrix only, but for some standard deviations."""
    n, depth = len(ions.directions), ions.depths[-1]
    blocks = np.minimum(np.arange(n) * _CLEAN_BLOCKS // n, _CLEAN_BLOCKS - 1)
    counts = np.bincount(blocks, minlength=_CLEAN_BLOCKS)
    clean = np.ones(_CLEAN_BLOCKS, bool)
    for one in features:
        # a mean over memberships, whose Gaussian reaches farther in depth than a block
        counted = n * max((one.neighbours * ions.volume) ** (1 / 3) / depth, 1 / _CLEAN_BLOCKS)
        noise = math.sqrt(one.background * (1 - one.background) / counted) / (one.content - one.background)
        share = np.bincount(blocks, np.clip(one.membership, 0, 1) if one.background == 0 else one.membership) / counts
        clean &= share < _CLEAN + allowed * noise
    clean[: int(0.04 * _CLEAN_BLOCKS)] = False
    return blocks, clean


def _matrix_flux(ions, features):
    """Flux at the rim over that of the whole view in stretches of matrix; that of a sphere, 1, without any."""
    blocks, clean = _clean_blocks(features, ions, 0.0)  # a mean: gaps do no harm, blocks of a phase do
    if not clean.any():
        return 1.0
    return float(ions.in_ring[clean[blocks]].mean()) / ions.ring_part


def _level(voltages, at_ions, features, ions):
    """Voltage of the matrix on a sphere: of the longest stretch of matrix, else such that V F of the matrix is 1."""
    blocks, clean = _clean_blocks(features, ions, _ALLOWED)
    edges = np.flatnonzero(np.diff(np.concatenate([[False], clean, [False]]).astype(int)))
    starts, stops = edges[::2], edges[1::2]
    if len(starts):
        longest = int((stops - starts).argmax())
        chosen = (blocks >= starts[longest]) & (blocks < stops[longest])
        if chosen.sum() > 0.05 * len(voltages):
            return float(voltages[chosen].mean())
    weights = _matrix(features)
    return float((voltages * at_ions * weights).sum() / max(weights.sum(), 1e-9))


def _found_fields(measured, features, compositions, values, positions):
    """Evaporation fields of the phases relative to the matrix by V F of their ions, and standard errors."""
    n = len(values)
    later = np.arange(n) >= int(_SPIN_UP * n)
    blocks = np.arange(n) * 20 // n  # of the sequence, left out one after the other for the errors

    def ratios(chosen):
        if measured.has_labels:
            reference = np.average(values[chosen], weights=matrix[chosen])
            inner = [chosen & core for core in cores]
            return np.array([values[core].mean() / reference if core.any() else np.nan for core in inner])
        parts = [type(one)(one.all[chosen], one.first[chosen], one.second[chosen]) for one in compositions]
        slopes = noise_free_slopes(values[chosen], parts)
        enriched = [part.all.mean() - one.background for part, one in zip(parts, features, strict=True)]
        reference = values[chosen].mean() - slopes @ enriched
        return 1 + slopes / reference * [one.content - one.background for one in features]

    matrix = _matrix(features)
    cores = []
    if measured.has_labels:
        near = [local_share(positions, one.own, _CORE, measured.ions.volume) for one in features]
        cores = [core_of(one.own, share) for one, share in zip(features, near, strict=True)]
    best = ratios(later)
    left_out = np.array([ratios(later & (blocks != block)) for block in range(20)])
    means = np.nansum(left_out, axis=0) / np.maximum(np.isfinite(left_out).sum(axis=0), 1)
    scatter = np.sqrt(np.nansum((left_out - means) ** 2, axis=0) * 19 / 20)
    counting = [one.content_error / (one.content - one.background) for one in features]
    return best, np.sqrt(scatter**2 + ((best - 1) * np.hypot(_FIELD_BIAS, counting)) ** 2)


def _placed(cap, measured, fixed, every, why, thinned):
    """All ions on the surface that the fields lead to."""
    ions = measured.ions
    surface = EvolvingSurface(ions)
    thresholds = np.repeat(fixed.fields, every)[: len(cap)]
    voltages = outside = None
    if fixed.way in ("surface", "both"):
        depths = ions.depths[1:]
        voltages = measured.voltages / (fixed.trend[0] + fixed.trend[1] * depths) / fixed.level
        part = ions.part(0, every) if every > 1 else ions
        outside = continued(fixed.features, fixed.positions, part.in_ring)[0]
    way = "surface" if fixed.way == "both" else fixed.way
    found = surface.integrate(voltages, thresholds, outside, way, fixed.flux)
    if fixed.way == "both":
        found = mean_pass(found, surface.integrate(rim=fixed.flux))
    edges = found.steps.first_ions
    means = np.full(len(edges) - 1, np.nan)
    if voltages is not None:
        total = np.concatenate([[0.0], np.cumsum(voltages)])
        means = np.diff(total[edges]) / np.maximum(np.diff(edges), 1)
    positions = found.positions.copy()
    positions[:, 2] = ions.radius - positions[:, 2]  # depth below the apex of the first sphere
    numbers = {name: k for k, name in enumerate(measured.names)}
    known = fixed.contrasts or [SoluteContrast(0.0, 1.0, math.nan, 0)] * len(numbers)
    seen = [k for k, one in enumerate(known) if not one.contrast < CONTRAST_GATE]
    known = list(known)
    for k, feature in zip(seen, fixed.features, strict=False):  # no features: no contrast was seen
        known[k] = replace(known[k], matrix=feature.background, phase=feature.content)
    ratios = np.where(np.isnan(fixed.errors), np.nan, fixed.ratios)
    phases = tuple(
        PhaseField(
            name, float(ratios[k]), float(fixed.errors[k]), int(measured.own[k].sum()), known[k].matrix,
            known[k].phase, known[k].contrast,
        )
        for name, k in numbers.items()
    )  # fmt: skip
    return EvolvingReconstruction(
        positions, cap.hits, ions.radius + ions.growth * found.apex_depths, cap.settings, cap.geometry,
        history=SurfaceHistory(surface, found, means), phases=phases, continuations=tuple(fixed.ways),
        verdict=_verdict(fixed, measured, why), apex_depths=found.apex_depths, ion_fields=thresholds,
        _followed=(thinned, fixed), _cap_radii=cap.radii,
    )  # fmt: skip


def _corrected(found, twin, directions):
    """The reconstruction without the mean errors of the twin, unless its density does not describe the measured one."""
    whole, worst = twin.gains(directions)
    said = (
        f"; the twin {{}}: by its density the ions are {math.exp(whole):.3f} times as likely as by an even one, "
        f"{math.exp(worst):.3f} times in the worst half of the view"
    )
    if min(whole, worst) <= 0:
        return replace(found, verdict=found.verdict + said.format("is not used"))
    shifts = twin.shifts_at(directions, found.radii) * (1.0, 1.0, -1.0)  # depth in place of z
    return replace(
        found, positions=found.positions + shifts, twin_errors=twin, verdict=found.verdict + said.format("is used")
    )


def _verdict(fixed, measured, why):
    """One sentence on what the surface was followed by."""
    share = max((way.share for way in fixed.ways), default=0.0)
    jumps = f"; {measured.jumps} jumps or restarts of the voltage were taken out" if measured.jumps else ""
    flux = f"{fixed.flux:.2f}"
    crystal = f", where the matrix has {flux} of that of the view" if flux != "1.00" else ""
    if fixed.way == "volume":
        found = "no phase is known"
        if fixed.bursts:
            found = (
                f"the rate at which ions of the phases leave varies by {fixed.bursts:.2f}, above {BURST_GATE:g}, in "
                "bursts as from terraces: no field follows, and widths may be 1.05 to 1.15 times too large"
            )
        elif measured.names:
            best = max(one.contrast for one in fixed.contrasts)
            found = f"no solute has a contrast over its noise, at most {best:.1f}"
        return f"followed by the volume of the ions, as the cap: {found}"
    if fixed.way == "ring":
        because = f", {why}" if why and measured.names else ""
        return f"followed by the flux at the rim: at most {share:.2f} of it is of a phase{crystal}{because}{jumps}"
    if fixed.way == "both":
        measures = f"of voltage and phases and of the flux at the rim{crystal}"
        return f"followed by the mean {measures}: at most {share:.2f} of the rim is of a phase{jumps}"
    how = {way.way for way in fixed.ways} - {"none"}
    ways = {"plane": "continued as a plane", "ring": "continued from the ions at its azimuth"}
    beyond = f", {' and '.join(ways[way] for way in sorted(how))}" if how else ""
    return f"followed by voltage and phases, up to {share:.2f} of the rim is of a phase{beyond}{jumps}"
