"""Settings of a simulation from a measured map: axis, rotation, radius, detector, emission, each with its origin."""

from __future__ import annotations

import math
import tomllib
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from apt_evap._common.codec import for_json
from apt_evap._common.digits import rounded_text
from apt_evap._common.files import open_for_reading, replace_file, sha256_of
from apt_evap._common.short_repr import short_repr
from apt_evap._common.types import AnyPath, Booleans, Floats
from apt_evap._common.validation import check_count, check_kind, check_number
from apt_evap._common.version import __version__
from apt_evap.detection.detector_map import DetectorMap
from apt_evap.detection.hits import Hits
from apt_evap.detection.microscope.local_electrode import LocalElectrode
from apt_evap.emission.perturbations import RollUp
from apt_evap.emission.roll_probability import Migration
from apt_evap.fit.indexed_registration import ENERGY, HEIGHT, ROLLS, SHARPNESS, registration_start
from apt_evap.maps.indexing.index_map import Indexing
from apt_evap.maps.indexing.orientation_search import disc_of
from apt_evap.simulation.config.cost_estimate import CostEstimate, estimate_cost, hours_text
from apt_evap.simulation.config.material_text import material_value
from apt_evap.simulation.config.perturbation_text import write_perturbation
from apt_evap.simulation.config.simulation_file import config_of
from apt_evap.simulation.config.toml_text import comment
from apt_evap.specimen.lattice import atom_density
from apt_evap.specimen.materials import EVAPORATION_FIELD_ERROR

MARK = "# Settings of a simulation, made from a measured map by apt_evap"
"""Beginning of the first line of the text."""
FIELD_FACTOR = 3.3
"""Field factor if there is no lens."""
FIELD_FACTORS = 2.0, 8.0
"""Range of the field factors of usual specimens (Gault et al., Atom Probe Microscopy)."""
FEWEST_IONS = 10_000
"""Ions that settings ask for at least."""
RADII = (80, 60, 50, 40, 32, 25, 20, 16, 12, 10)
"""Radii of simulated tips [lattice constants], the largest one that the time allows is taken."""
_CONTENT = "SHA-256 of its content: "  # of the measured file
_SIMULATED_COMPRESSION = 1.03  # of free tips with R = 20 to 80 a: 1.02 to 1.045, measured with the master patterns
_MARGIN = 1.1  # of the simulated field of view beyond the measured one
_ENDS = 1000  # ions at the beginning and at the end of a measurement, for its radii
_PART = 0.2  # of the volume of the cap that may evaporate: the shape stays near the sphere
_MOST_ENERGY = 2.5  # eV; of ions by the rule of a metal, one in ten million has more
_VOLTAGE = 1000.0  # V, of a simulation
# eV at this voltage: the default of responses, and where they are exact: of 3,000 ions of nickel with R = 16 a none is
# flagged with 5 eV, 1,956 with 12.7
_LIMITS = 1.5, 5.0
_MOST = 150_000  # ions
# Part of the time of a run in which only one thread has work: events follow one another, 0.2 of the 0.93 ms of an ion.
# Two threads are 1.67 times as fast with it; measured 1.49, 1.86 and 2.1 (R = 20, 40 and 80 a), more not measured.
_ONE_AFTER_ANOTHER = 0.2
_FILLED = 0.95  # of the time that is used at least, if the bounds of the ions allow it


@dataclass(frozen=True, eq=False)
class StartSettings:
    """Settings of a simulation of a measured specimen.

    Parameters
    ----------
    text : str
        Settings file (TOML), with the origin of each number as a comment.
    indexing : Indexing
        The indexing of the map that they are made from.
    radii : tuple of float
        Radius of the measured specimen at the beginning and at the end of the measurement [nm], NaN if it has no
        voltages.
    simulated_radius : float
        Radius of the simulated tip [nm].
    registration : dict
        Where the simulated map is on the measured one, for `register`, see `registration_start`.
    cost : CostEstimate
        Time and memory that the simulation needs.
    """

    text: str
    indexing: Indexing
    radii: tuple[float, float]
    simulated_radius: float
    registration: dict
    cost: CostEstimate

    def __repr__(self) -> str:
        return short_repr(self)

    @property
    def size_text(self) -> str:
        """Which radius is simulated for which measured one, and why."""
        if math.isnan(self.radii[0]):
            measured = "that of the specimen is not known, the file has no voltages"
        else:
            low, high = sorted(self.radii)
            measured = f"that of the specimen is {low:.0f} to {high:.0f} nm by its voltages"
        is_largest = self.simulated_radius >= RADII[0] * self.indexing.best.orientation.material.a
        why = (
            "the largest that is simulated" if is_largest else "the largest of those not above it that the time allows"
        )
        minutes = "" if self.cost.hours is None else f", about {hours_text(self.cost.hours)} of one processor"
        return f"simulating R = {self.simulated_radius:.1f} nm, {why}{minutes}; {measured}"

    def to_dict(self) -> dict[str, Any]:
        """Return radii [nm], None if they are not known, and the indexing in plain types, dict."""
        return for_json({"radii": self.radii, "simulated_radius": self.simulated_radius}) | self.indexing.to_dict()

    def save(self, path: AnyPath) -> None:
        """Write the settings file; it is replaced only when complete."""
        with replace_file(path) as file:
            file.write(self.text.encode())


def is_start(path: AnyPath) -> bool:
    """Whether a file is a settings file made from a measured map."""
    with open_for_reading(path) as file:
        return file.read(len(MARK)) == MARK.encode()


def registration_start_of(path: AnyPath, measured: DetectorMap) -> dict[str, Any]:
    """Return `registration_start` of a run, read from its settings file.

    Returns
    -------
    dict
        Empty if the settings were not made from the file of the map, as it is now.
    """
    with open_for_reading(path) as file:
        text = file.read().decode()
    content = _content_of(measured)
    if not content or comment(content) not in text.splitlines():
        return {}
    distance = check_number(tomllib.loads(text).get("detector", {}).get("distance"), "detector.distance", above=0)
    return registration_start(disc_of(measured).centre, distance / _SIMULATED_COMPRESSION)


def _content_of(measured):
    """Line with the digest of the file of a map; "" if the map is not of a file."""
    try:
        return f"{_CONTENT}{sha256_of(measured.source)}" if measured.source else ""
    except (OSError, ValueError):  # a source that is no file, such as "simulation, RollUp(0.1)"
        return ""


def settings_of(
    indexing: Indexing,
    hits: Hits | None = None,
    *,
    lens: LocalElectrode | None = None,
    field_factor: float | None = None,
    minutes: float = 10.0,
    threads: int = 1,
    part: float = 1.0,
    spare: float = 1.0,
) -> StartSettings:
    """Make the settings of a simulation of a measured specimen.

    Parameters
    ----------
    indexing : Indexing
        Result of `index` for the measured map. Its first candidate is taken; if the map does not decide, the text says
        so.
    hits : Hits, optional
        The measured ions, whose voltages give the radius.
    lens : LocalElectrode, optional
        Lens of the instrument, which gives the field factor for a radius.
    field_factor : float, optional
        Field factor without a lens; 3.3 by default.
    minutes : float
        Time that the simulation may take, with what follows. Its tip is smaller than the measured one if necessary.
    threads : int
        Threads of the simulation.
    part : float
        Part of this time that the simulation has, above 0 and at most 1.
    spare : float
        Times the ions of this time that the settings ask for, for a run that ends with its time (`simulate`). The
        shape of the tip limits them.

    Returns
    -------
    StartSettings

    Raises
    ------
    ValueError
        If an argument is outside its range, or no tip is small enough for the time.

    Notes
    -----
    The radius is R = V / (k_f F), with the evaporation field F of the material and the sum V of standing and pulse
    voltage. Maps change slowly with the radius: poles are sqrt(2 d / R) wide.

    Examples
    --------
    >>> truth = ae.Orientation("W", axis=(0.1, 0.6, 0.8))
    >>> pattern = ae.maps.master_patterns("bcc")[0]
    >>> measured = pattern.map(truth, ae.detection.Projection(60.0), width=70.0, ions=20_000, seed=1)
    >>> start = ae.fit.settings_of(ae.index(measured, "W", scales=(58, 62)), minutes=1)
    >>> start.save("w.toml")
    >>> from apt_evap.simulation.config.simulation_file import read_config
    >>> read_config("w.toml").tip["material"].name
    'W'
    """
    check_kind(indexing, "indexing", Indexing, "an Indexing, the result of index")
    if hits is not None:
        hits = without_strays(check_kind(hits, "hits", Hits, "Hits"))
    if lens is not None:
        check_kind(lens, "lens", LocalElectrode, "a LocalElectrode")
        if field_factor is not None:
            raise ValueError("give lens or field_factor, not both")
    factor = FIELD_FACTOR if field_factor is None else check_number(field_factor, "field_factor", above=0)
    factors = FIELD_FACTORS if field_factor is None else (factor, factor)
    alone = _ONE_AFTER_ANOTHER  # of the time of one thread that `minutes` of wall time are worth
    speed = 1 / (alone + (1 - alone) / check_count(threads, "threads", at_least=1))
    speed *= check_number(part, "part", above=0, at_most=1)
    budget = check_number(minutes, "minutes", above=0, unit="min") * speed / 60
    best = indexing.best
    material = best.orientation.material
    radii = _radii(hits, material.evaporation_field, lens, factor)
    radius = math.nan if math.isnan(radii[0]) else sum(radii) / 2
    sizes = [size for size in RADII if not size * material.a > radius] or [RADII[-1]]
    for size in sizes:
        text, needs = _costed(indexing, radii, size, lens, factors, threads)
        if needs.hours is not None and needs.hours <= budget:
            more = 1.0
            while needs.hours < _FILLED * budget:  # more ions, up to the bounds of the shape
                more *= budget / needs.hours
                before = needs.ions
                text, needs = _costed(indexing, radii, size, lens, factors, threads, more)
                if needs.ions == before:
                    break
            if check_number(spare, "spare", at_least=1) > 1:
                text, _ = _costed(indexing, radii, size, lens, factors, threads, more * spare)
            break
    else:
        least = math.ceil(600 * (needs.hours or 0.0) / speed) / 10  # 0.1 is not enough where 0.11 is needed
        raise ValueError(f"minutes must be at least {least:g} for the smallest tip, got {minutes:g}")
    return StartSettings(
        text,
        indexing,
        radii,
        size * material.a,
        registration_start(best.projection.centre, best.projection.scale),
        needs,
    )


def without_strays(hits: Hits) -> Hits:
    """The ions but those far outside the field of view."""
    if hits.outcome is not None or hits.x is None or hits.y is None:
        return hits
    kept = hits.detected | ~np.isfinite(hits.x) | ~np.isfinite(hits.y)
    return hits if kept.all() else hits[kept]


def voltages_of(hits: Hits | None) -> Floats | None:
    """Standing voltage plus pulse of the ions that have one [V], None if there is none."""
    if hits is None or hits.voltage is None:
        return None
    voltages = hits.total_voltage[has_voltage(hits)]
    return voltages.astype(float) if len(voltages) else None


def has_voltage(hits: Hits) -> Booleans:
    """Whether the voltage of an ion is known: finite and above 0; bool (n,)."""
    voltages = hits.total_voltage
    return np.isfinite(voltages) & (voltages > 0)


def _radii(hits, field, lens, factor):
    """Radii at both ends of a measurement [nm]."""
    voltages = voltages_of(hits)
    if voltages is None:
        return math.nan, math.nan
    ends = [float(np.median(part)) for part in (voltages[:_ENDS], voltages[-_ENDS:])]
    if lens is None:
        return ends[0] / (factor * field), ends[1] / (factor * field)
    return float(lens.radius(ends[0], field)), float(lens.radius(ends[1], field))


def _costed(indexing, radii, size, lens, factors, threads, more=1.0):
    """The settings file, and the cost of its run."""
    text = _text(indexing, radii, size, lens, factors, more)
    return text, estimate_cost(config_of(tomllib.loads(text), Path("settings.toml")), threads)


def _text(indexing, radii, size, lens, factors, more):
    """The settings file; `more` times as many ions as a lattice constant of the cap has."""
    best = indexing.best
    material, projection = best.orientation.material, best.projection
    atoms = atom_density(material.structure, material.a, material.c) * material.a**3
    layers = 2 * math.pi * atoms * size**2 * more  # a lattice constant of the cap
    ions = int(min(max(layers, FEWEST_IONS), _PART * 2 / 3 * math.pi * atoms * size**3, _MOST))
    disc = disc_of(indexing.map)
    x, y = np.meshgrid(*indexing.map.centres)
    reach = np.hypot(x - disc.centre[0], y - disc.centre[1])[disc.map.mask].max()
    # V = k_f F R of a free tip, with k_f of 1.0 to 1.2
    volts = material.evaporation_field * size * material.a
    limit = float(np.clip(_MOST_ENERGY * _VOLTAGE / (material.charge_state * volts), *_LIMITS))
    lines = [
        f"{MARK} {__version__}.",
        comment(f"Measured: {indexing.map.source or 'a map'}"),
        *([comment(content)] if (content := _content_of(indexing.map)) else ()),
        *(() if indexing.decided else ("# NOT DECIDED: axis and rotation are those of the first candidate.",)),
        "",
        *_tip_lines(indexing, radii, size, lens, factors),
        "",
        "[simulation]",
        f"ions = {ions:_}    # some layers of the cap",
        "",
        "[rule]    # charges and law whose lines are where measured ones of tungsten are",
        'name = "ConstantPotential"',
        "",
        "[responses]",
        f"energy_limit = {limit:.2f}    # eV at the simulated voltage, {_VOLTAGE:g} V",
        "",
        "[flights]",
        'field_of_view = "detector"    # only ions that can arrive are flown; all atoms evaporate',
        "",
        "[detector]    # so large and so far away that the simulated map has the size of the measured one",
        'projection = "equidistant"    # closer to measured maps than a plane',
        f"distance = {projection.scale * _SIMULATED_COMPRESSION:.2f}    # mm: the scale of the map, "
        f"{projection.scale:.1f} mm/rad, times the image compression of a free tip",
        f"width = {2 * _MARGIN * reach:.1f}    # mm: the measured field of view and a tenth more",
        "",
        "[real_units]    # energies are those of an experiment",
        "",
        "[maps]",
        "",
        "[[maps.panels]]",
        'title = "unperturbed"',
        'perturbation = "Unperturbed"',
        "",
        "[[maps.panels]]",
        *_emission(best.rolled),
        *_of_metal(material),
        "",
    ]
    return "\n".join(lines)


def _tip_lines(indexing, radii, size, lens, factors):
    """The table of the specimen."""
    best = indexing.best
    material = best.orientation.material
    others = [] if indexing.decided else [candidate.orientation for candidate in indexing.candidates[1:]]
    shank = 3.0 if lens is None else lens.shank_angle
    shank_why = "assumed, it hardly changes the map of the cap" if lens is None else "that of the lens"
    return [
        "[tip]",
        f"material = {material_value(material)}",
        f"axis = {_axis_text(best.orientation)}    # at the centre of the map, within {best.angle_error:.1f} degrees "
        "by its noise",
        f"# {'' if indexing.decided else 'NOT DECIDED: '}{indexing.reason}",
        *(f"#   or axis = {_axis_text(other)}, rotation = {other.rotation:.2f}" for other in others),
        f"rotation = {best.orientation.rotation:.2f}    # of the crystal on the map; the map is not mirrored",
        f'apex_radius = "{size:g} a"    # simulated: {size * material.a:.1f} nm',
        f"# {_radius_text(material, radii, lens, factors)}",
        f'shank_length = "{2 * size:g} a"',
        f"shank_angle = {shank:g}    # degrees: {shank_why}",
        'depth = "6 a"    # atoms deeper below the surface are not kept in memory',
        "offset_seed = 1    # no atom on the axis",
    ]


def _axis_text(orientation):
    return f"[{', '.join(f'{component:.4f}' for component in orientation.axis)}]"


def _radius_text(material, radii, lens, factors):
    """The radius with the digits that the field factor, or else the evaporation field, allows."""
    if math.isnan(radii[0]):
        return "the radius of the specimen is not known: the file has no voltages"
    field = f"F = {material.evaporation_field:g} V/nm"
    if lens is None and factors[1] > factors[0]:
        low, high = (FIELD_FACTOR * sum(radii) / 2 / factor for factor in factors[::-1])
        radius, low, high = (rounded_text(value, (high - low) / 2) for value in (sum(radii) / 2, low, high))
        known = f"k_f = {FIELD_FACTOR:g} ({factors[0]:g} to {factors[1]:g})"
        return f"the specimen has R = {radius} nm ({low} to {high}), by V = k_f F R with {known} and {field}"
    first, last = (rounded_text(value, EVAPORATION_FIELD_ERROR * value) for value in radii)
    by = "the lens" if lens is not None else f"k_f = {factors[0]:g}"
    return f"the specimen has R = {first} to {last} nm, by V = k_f F R with {by} and {field}"


def _emission(rolled):
    """Lines of the panel with the emission that the patterns suggest."""
    why = f"# the map has {rolled:.1f} of the pattern of ions that roll up; the energy is to be fitted"
    if rolled < ROLLS:
        table = f'{{ name = "LateralVelocity", energy = {ENERGY}, height = {HEIGHT} }}'
        return ['title = "lateral velocities"', f"perturbation = {table}    # eV", why]
    table = f'{{ name = "RollUp", energy = {ENERGY}, height = {HEIGHT}, sharpness = {SHARPNESS}, '
    table += f"probability = {rolled:.2f} }}"
    return ['title = "roll-up"', f"perturbation = {table}    # eV", why]


def _of_metal(material):
    """Lines of the panel with the rule of the metal, if the material has the numbers of one."""
    if material.cohesive_energy is None:
        return []
    try:
        perturbation = RollUp.of_metal(material)
    except ValueError:
        return []
    low, middle, high = (
        Migration(material.cohesive_energy, factor * material.evaporation_field).threshold
        for factor in (1 + EVAPORATION_FIELD_ERROR, 1.0, 1 - EVAPORATION_FIELD_ERROR)
    )
    return [
        "",
        "[[maps.panels]]",
        'title = "roll-up predicted for the metal"',
        "# its numbers were selected with maps of W, Ni and Al, none with this map. Atoms roll up if the charge of a "
        f"neighbour over theirs is above {middle:.2f};",
        f"# for an evaporation field that is a tenth higher or lower, above {low:.2f} or {high:.2f}, which may decide "
        "which lines are bright",
        f"perturbation = {write_perturbation(perturbation)}",
    ]
