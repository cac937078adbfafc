"""Constants of a measurement with errors, what each depends on, and checks by observables that were not used."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np
import scipy

from apt_evap._common.digits import rounded_text
from apt_evap._common.short_repr import short_repr
from apt_evap._common.validation import check_kind, check_number
from apt_evap.detection.detector_map import DetectorMap
from apt_evap.detection.hits import Hits, MassRanges
from apt_evap.detection.microscope.local_electrode import LocalElectrode
from apt_evap.emission.post_ionisation import RATIO_PARAMETERS
from apt_evap.fit.start_settings import FIELD_FACTOR, FIELD_FACTORS, has_voltage, voltages_of, without_strays
from apt_evap.maps.indexing.index_map import Candidate
from apt_evap.maps.indexing.orientation_search import disc_of
from apt_evap.maps.indexing.refine import bins_of, refine, resolution
from apt_evap.reconstruction.reconstruct import reconstruct
from apt_evap.reconstruction.shank import fit_shank
from apt_evap.specimen.lattice import atom_density
from apt_evap.specimen.materials import EVAPORATION_FIELD_ERROR
from apt_evap.spectra.charge_states import LEAST, charge_history, field_of_counts, ion_charges, ratio_of_counts

_ENDS = 1000  # ions at the beginning and at the end, for the voltages there
_IONS = 20_000  # that are reconstructed for the angle of the shank
_SECTIONS = 40  # of the sequence, for a slope and its error
_DEEP = 0.05  # radii that the apex must recede for an angle of the shank: over less, the apex changes its shape
_FEWEST = 5_000  # ions of each half, for its scale
_STEP = 0.01  # relative, for sensitivities
_MEDIAN = math.sqrt(math.pi / 2)  # standard error of a median, in that of a mean


class Constant(NamedTuple):
    """A constant of a measurement."""

    name: str
    """Name of the observable, with its unit."""
    value: float
    """Value of the constant; NaN if it is not determined."""
    error: float
    """Standard error by noise alone; NaN if it is not known."""
    depends: str
    """Constants with which it is degenerate, or the reason why it is not determined."""
    between: tuple[float, float] | None = None
    """Values for the range of a constant that is assumed; None if none is."""
    needs_crystal: bool = True
    """Whether it is wrong if the crystal or its orientation is."""

    @property
    def text(self) -> str:
        """Value and error, with the digits that the error and an assumed constant allow."""
        if math.isnan(self.value):
            return "not determined"
        if self.between is not None and (width := abs(self.between[1] - self.between[0]) / 2) > 0:
            number, low, high = (rounded_text(value, width) for value in (self.value, *self.between))
            return f"{number} ({low} to {high})"
        if math.isnan(self.error):
            return rounded_text(self.value, math.nan, 4)
        return f"{rounded_text(self.value, self.error)} ± {rounded_text(self.error, self.error)}"


class Observed(NamedTuple):
    """An observable that was not used for the constants, beside its expectation."""

    name: str
    """Name of the observable, with its unit."""
    value: float
    """Value in the measurement."""
    expected: float
    """Value expected from the constants."""
    error: float
    """Standard error of the difference, by noise alone."""
    meaning: str
    """Meaning of a deviation."""

    @property
    def z(self) -> float:
        """Deviation in standard errors."""
        return (self.value - self.expected) / self.error

    @property
    def text(self) -> str:
        """Measured and expected value, and their deviation, as text."""
        return f"{self.found}, expected {self.predicted}"

    @property
    def found(self) -> str:
        """Measured value as text."""
        return rounded_text(self.value, self.error)

    @property
    def predicted(self) -> str:
        """Expected value with its error, and the deviation, as text."""
        expected, error = (rounded_text(number, self.error) for number in (self.expected, self.error))
        return f"{expected} ± {error}: z = {self.z:+.1f}"


@dataclass(frozen=True, eq=False)
class Measurement:
    """Constants of a measurement, made by `constants_of`.

    Parameters
    ----------
    constants : tuple of Constant
        The constants.
    checks : tuple of Observed
        Observables that were not used.
    arguments : dict
        Arguments of `reconstruct` for the ions; empty for a map without ions.
    """

    constants: tuple[Constant, ...]
    checks: tuple[Observed, ...]
    arguments: dict[str, Any]

    def without_crystal(self) -> Measurement:
        """What remains if the crystal or its orientation is in doubt: no checks, and no arguments of `reconstruct`."""
        return Measurement(tuple(constant for constant in self.constants if not constant.needs_crystal), (), {})

    def __repr__(self) -> str:
        return short_repr(self)

    def __str__(self) -> str:
        rows = [f"{constant.name}: {constant.text}; {constant.depends}" for constant in self.constants]
        rows += [f"check, {check.name}: {check.text}; {check.meaning}" for check in self.checks]
        return "\n".join(rows)


@dataclass(frozen=True)
class _Assumed:
    """What is assumed about the crystal and the instrument, see `constants_of`; `factors` is the range of `factor`."""

    field: float
    volume: float
    lens: LocalElectrode | None
    factor: float
    factors: tuple[float, float]
    length: float | None
    efficiency: float

    def compression(self, voltage: float) -> float:
        """Image compression of the lens at a voltage [V]."""
        lens: Any = self.lens
        return float(lens.compression(float(lens.radius(voltage, self.field))))

    def arguments(self, disc: Any, scale: float) -> dict[str, Any]:
        """Arguments of `reconstruct` for a map with this disc and scale."""
        arguments: dict[str, Any] = {
            "atomic_volume": self.volume,
            "evaporation_field": self.field,
            "efficiency": self.efficiency,
            "detector_radius": disc.radius - math.hypot(*disc.centre),
        }
        if self.length is None:
            return arguments
        arguments["distance"] = self.length
        if self.lens is not None:
            return arguments | {"lens": self.lens}
        of_map = {"compression": self.length / scale, "projection": "equidistant", "field_factor": self.factor}
        return arguments | of_map


def constants_of(
    measured: DetectorMap,
    candidate: Candidate,
    hits: Hits | None = None,
    *,
    lens: LocalElectrode | None = None,
    field_factor: float | None = None,
    distance: float | None = None,
    efficiency: float = 0.5,
    ranges: MassRanges | None = None,
) -> Measurement:
    r"""Determine the constants of a measurement with errors, and check them.

    Parameters
    ----------
    measured : DetectorMap
        The map.
    candidate : Candidate
        Its orientation, such as ``index(measured, "Ni").best``.
    hits : Hits, optional
        The ions of the map, in the sequence of evaporation.
    lens : LocalElectrode, optional
        Lens of the microscope, for the field factor, the compression and the radius of every voltage.
    field_factor : float, optional
        Field factor without a lens; 3.3 by default.
    distance : float, optional
        Flight length [mm].
    efficiency : float
        Fraction of the evaporated atoms in the field of view that are among `hits`.
    ranges : Ranges, optional
        Ranges of mass of the ions, for the charge states of the element.

    Returns
    -------
    Measurement

    Raises
    ------
    ValueError
        If an argument is outside its range.

    Notes
    -----
    The scale s of the map is that of the best likelihood. It fixes the image compression as :math:`\xi = L/s`, so only
    :math:`L/\xi` is measured. A voltage fixes the product :math:`k_f F R = V` of field factor, evaporation field and
    radius. A lens gives :math:`k_f` for every R, so that R follows from F. The angle of the shank follows from the
    change of the radius along the depth as in `reconstruction.fit_shank`; the depth is that of the volume of the ions,
    with the angle :math:`\rho/s` at the rim of the map.

    Errors are those of noise. Those of F, of the efficiency, and of the geometry of the microscope are not included:
    `Constant.depends` describes what they change.

    Examples
    --------
    >>> truth = ae.Orientation("W", axis=(0.1, 0.6, 0.8))
    >>> pattern = ae.maps.master_patterns("bcc")[0]
    >>> measured = pattern.map(truth, ae.detection.Projection(60.0), width=70.0, ions=20_000, seed=1)
    >>> best = ae.index(measured, "W", scales=(55, 65)).best
    >>> scale, compression = ae.fit.constants_of(measured, best, distance=90.0).constants
    >>> f"{scale.name} {scale.value:.0f}, {compression.name} {compression.value:.1f}"
    'scale of the map [mm/rad] 60, image compression 1.5'
    """
    check_kind(measured, "measured", DetectorMap, "a DetectorMap")
    check_kind(candidate, "candidate", Candidate, "a Candidate, such as index(map, material).best")
    if lens is not None:
        check_kind(lens, "lens", LocalElectrode, "a LocalElectrode")
        if field_factor is not None:
            raise ValueError("give lens or field_factor, not both")
    factor = FIELD_FACTOR if field_factor is None else check_number(field_factor, "field_factor", above=0)
    efficiency = check_number(efficiency, "efficiency", above=0, at_most=1)
    length = None if distance is None else check_number(distance, "distance", above=0, unit="mm")
    material = candidate.orientation.material
    scale, scale_error = candidate.projection.scale, _scale_of(measured, candidate)[1]
    constants = [
        Constant("scale of the map [mm/rad]", scale, scale_error, "flight length / image compression, fixed by the map")
    ]
    checks: list[Observed] = []
    if length is not None:
        compression, error = length / scale, length / scale * (scale_error / scale)
        why = "proportional to the assumed flight length: the map fixes only their ratio"
        constants.append(Constant("image compression", compression, error, why))
    if hits is not None:
        hits = without_strays(check_kind(hits, "hits", Hits, "Hits"))
    if hits is None or (voltages := voltages_of(hits)) is None:
        return Measurement(tuple(constants), tuple(checks), {})
    volume = 1 / atom_density(material.structure, material.a, material.c)
    factors = FIELD_FACTORS if field_factor is None else (factor, factor)
    assumed = _Assumed(material.evaporation_field, volume, lens, factor, factors, length, efficiency)

    # constants by the voltage: field, radius and field factor; then the angle of the shank by its increase
    constants += _voltage_constants(voltages, assumed)
    disc = disc_of(measured)  # a few ions are far outside the field of view
    constants.append(_shank(hits, disc, scale, assumed))

    # observables that were not used: compression of the lens, halves of the ions, multiple hits, charges
    if lens is not None and length is not None:
        checks.append(
            Observed(
                "image compression of the map, against that of the lens",
                length / scale,
                assumed.compression(float(np.median(voltages))),
                length / scale * (scale_error / scale),
                "flight length, shank or electrode are wrong; the evaporation field hardly matters",
            )
        )
    checks += _halves(measured, candidate, hits, voltages, assumed)
    checks += _sequence(hits, voltages)
    if ranges is not None and hits.mass_to_charge is not None:
        checks += _charges(hits, material, ranges)
    return Measurement(tuple(constants), tuple(checks), assumed.arguments(disc, scale))


def _scale_of(measured, candidate):
    """Scale of a map near a candidate, and its error by noise [mm/rad]."""
    disc = disc_of(measured)
    bins, scale = bins_of(disc), candidate.projection.scale
    densities = candidate.pattern.smoothed(resolution(disc, scale))
    amplitudes = 0.5 * np.array([1 - candidate.rolled, candidate.rolled])
    fitted = refine(bins, disc, densities, candidate.orientation.matrix, scale, amplitudes, steps=20)
    return fitted.scale, fitted.scale * math.sqrt(fitted.covariance[3, 3] * fitted.dispersion)


def _voltage_constants(voltages, assumed):
    """Voltages of both ends, and what they give."""
    constants: list[Constant] = []
    field, lens, factor, factors = assumed.field, assumed.lens, assumed.factor, assumed.factors
    fields = field * (1 + EVAPORATION_FIELD_ERROR), field * (1 - EVAPORATION_FIELD_ERROR)
    for where, part in (("first", voltages[:_ENDS]), ("last", voltages[-_ENDS:])):
        voltage = float(np.median(part))
        error = _MEDIAN * float(np.std(part)) / math.sqrt(len(part)) or math.nan  # a supply has steps
        fixed = "the product field factor x evaporation field x radius"
        name = f"voltage of the {where} ions [V]"
        constants.append(Constant(name, voltage, error, fixed, needs_crystal=False))
        if lens is None:
            radius = voltage / (factor * field)
            why = f"for k_f = {factor:g} and F = {field:g} V/nm: 1 % more of either is 1 % less; between them for "
            low, high = (voltage / (factors[1] * field), voltage / (factors[0] * field))
            if low == high:
                low, high = (voltage / (factor * other) for other in fields)
                why += f"{fields[1]:.3g} to {fields[0]:.3g} V/nm"
            else:
                why += f"k_f of {factors[0]:g} to {factors[1]:g}"
            name = f"radius at the {where} ions [nm]"
            constants.append(Constant(name, radius, radius * error / voltage, why, (low, high)))
            continue
        radius = float(lens.radius(voltage, field))
        less = 100 * (float(lens.radius(voltage, field * (1 + _STEP))) / radius - 1)
        why = f"for F = {field:g} V/nm: {less:+.2f} % for 1 % more F"
        if where == "first":
            blunt = replace(lens, shank_angle=lens.shank_angle + 1, profile=None) if lens.profile is None else None
            far = replace(lens, distance=lens.distance * (1 + 10 * _STEP))
            for text, other in ((" for a shank 1 degree blunter", blunt), (" for 10 % more distance", far)):
                if other is not None:
                    why += f", {100 * (float(other.radius(voltage, field)) / radius - 1):+.2f} %{text}"
        slope = math.log(float(lens.radius(voltage * (1 + _STEP), field)) / radius) / math.log(1 + _STEP)
        why += f"; between them for {fields[1]:.3g} to {fields[0]:.3g} V/nm"
        low, high = (float(lens.radius(voltage, other)) for other in fields)
        name = f"radius at the {where} ions [nm]"
        constants.append(Constant(name, radius, radius * slope * error / voltage, why, (low, high)))
        of_lens = "of the lens at this radius"
        constants.append(
            Constant(f"field factor at the {where} ions", float(lens.field_factor(radius)), math.nan, of_lens)
        )
        constants.append(
            Constant(f"image compression at the {where} ions", float(lens.compression(radius)), math.nan, of_lens)
        )
    return constants


def _shank(hits, disc, scale, assumed):
    """Angle of the shank from the history of the voltage."""
    lens, length, efficiency = assumed.lens, assumed.length, assumed.efficiency
    of_ions = {
        "atomic_volume": assumed.volume,
        "evaporation_field": assumed.field,
        "detector_radius": disc.radius,
    }
    name = "angle of the shank [degrees]"
    if hits.x is None or hits.y is None:
        return Constant(name, math.nan, math.nan, "the ions have no places")
    placed = replace(hits[has_voltage(hits)].within_circle(disc.radius, disc.centre), extent=None)
    placed = replace(placed, x=placed.x - disc.centre[0], y=placed.y - disc.centre[1])
    if lens is not None and length is not None:
        if lens.profile is not None:
            return Constant(name, math.nan, math.nan, "the lens has a profile")
        try:
            fit = fit_shank(placed, lens, distance=length, efficiency=efficiency, **of_ions)
        except ValueError as error:
            return Constant(name, math.nan, math.nan, str(error))
        depth, radius, angle, error = float(np.ptp(fit.depths)), float(fit.radii.mean()), fit.angle, fit.error
        why = ", ".join(
            f"{change:+.2g} degrees for 1 % more {assumption}" for assumption, change in fit.per_cent.items()
        )
    else:
        # from R(z) of a reconstruction: dR/dz = sin a / (1 - sin a) for the angle a of the shank
        every = max(1, -(-len(placed) // _IONS))
        # with the flight length and the compression of the map their ratio alone matters
        reconstruction = reconstruct(
            placed[::every], distance=scale, compression=1.0, projection="equidistant",
            field_factor=assumed.factor, efficiency=efficiency / every, **of_ions,
        )  # fmt: skip
        parts = np.array_split(np.arange(len(reconstruction)), min(_SECTIONS, len(reconstruction)))
        depths, radii = (
            np.array([column[part].mean() for part in parts])
            for column in (reconstruction.depths, reconstruction.radii)
        )
        depth, radius = float(np.ptp(depths)), float(radii.mean())
        if len(parts) < 3 or depth == 0:
            return Constant(name, math.nan, math.nan, "there are too few ions")
        line = scipy.stats.linregress(depths, radii)
        if not line.slope > 0:
            return Constant(name, math.nan, math.nan, "the voltage does not rise")
        sine = line.slope / (1 + line.slope)
        angle = math.degrees(math.asin(sine))
        error = math.degrees(line.stderr * (1 - sine) ** 2 / math.sqrt(1 - sine * sine))
        why = "dR/dz is proportional to efficiency / (k_f F)^3"
    if depth < _DEEP * radius:
        why = f"the apex receded by {depth:.2g} nm, {depth / radius:.1%} of its radius: {100 * _DEEP:g} % are needed"
        return Constant(name, math.nan, math.nan, why)
    return Constant(name, angle, error, f"for an efficiency of {efficiency:g}; {why}")


def _halves(measured, candidate, hits, voltages, assumed):
    """Scale of the second half of the ions against that of the first one."""
    detected = hits[hits.detected]
    half = len(detected) // 2
    if half < _FEWEST or not measured.is_counts:
        return []
    parts = [detected[:half], detected[half:]]
    (first, first_error), (second, second_error) = (
        _scale_of(part.map(like=measured, position_step=None), candidate) for part in parts
    )
    expected = 1.0
    if assumed.lens is not None:
        ends = [float(np.median(half)) for half in np.array_split(voltages, 2)]
        before, after = map(assumed.compression, ends)
        expected = before / after
    error = second / first * math.hypot(first_error / first, second_error / second)
    meaning = "the image compression changes during the measurement"
    return [Observed("scale of the second half / first half", second / first, expected, error, meaning)]


def _sequence(hits, voltages):
    """Slope of the voltage and share of multiple hits, second half against the first one."""
    checks = []
    if len(voltages) >= 2 * _FEWEST:
        slopes = []
        for part in np.array_split(voltages, 2):
            sections = np.array([section.mean() for section in np.array_split(part, _SECTIONS // 2)])
            line = scipy.stats.linregress(np.arange(len(sections)) * len(part) / len(sections) / 1000, sections)
            slopes.append((line.slope, line.stderr))
        (first, first_error), (second, second_error) = slopes
        checks.append(
            Observed(
                "rise of the voltage in the second half, against the first one [V per 1000 ions]",
                float(second), float(first), float(math.hypot(first_error, second_error)),
                "the apex has no stable shape yet, or the rate was changed",
            )
        )  # fmt: skip
    if hits.multiplicity is not None and len(hits) >= 2 * _FEWEST:
        several = np.array_split(np.asarray(hits.multiplicity) > 1, 2)
        before, after = (float(half.mean()) for half in several)
        # ions of a pulse are not independent: at least two of each
        error = math.sqrt(2 * (before * (1 - before) / len(several[0]) + after * (1 - after) / len(several[1])))
        if error > 0:
            meaning = "the rate, and with it the field of evaporation, changes"
            checks.append(Observed("share of multiple hits, second half against first", after, before, error, meaning))
    return checks


def _charges(hits, material, ranges):
    """Charge states of the element: their change, and the field that they give."""
    try:
        charges = np.where(hits.detected, ion_charges(hits, material.name, ranges), 0)
        history = charge_history(charges, material.name)
        history = charge_history(charges, material.name, history.charge, sections=2)
    except ValueError:  # other elements, or one charge
        return []
    if (history.lower + history.upper).min() < LEAST:
        return []
    (ratio, error), pair = ratio_of_counts(history.lower, history.upper), f"{history.charge + 1}+ / {history.charge}+"
    checks = [
        Observed(
            f"ln of {material.name} {pair}, second half against first", float(np.log(ratio[1])),
            float(np.log(ratio[0])), float(np.hypot(*error)), "the field of evaporation changes",
        )
    ]  # fmt: skip
    if material.name in RATIO_PARAMETERS:
        field, field_error = field_of_counts(material.name, history.charge, history.lower.sum(), history.upper.sum())
        meaning = "the assumed evaporation field is not on the scale of the charge states (Kingham)"
        checks.append(
            Observed(
                f"field by {pair} [V/nm]", float(field), float(material.evaporation_field), float(field_error), meaning
            )
        )
    return checks
