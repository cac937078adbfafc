"""Summary of a run, a file of ions or a map, in plain types."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from apt_evap._common.types import Floats
from apt_evap.detection.binning import find_quantisations
from apt_evap.detection.detector_map import DetectorMap
from apt_evap.detection.hits import Hits
from apt_evap.detection.ion_blocks import IonBlocks
from apt_evap.simulation.run import Run
from apt_evap.specimen.orientation_check import apex_sphere, depths, pointing, upright
from apt_evap.specimen.tip import Tip

UNITS = {
    "x": "mm",
    "y": "mm",
    "time_of_flight": "ns",
    "voltage": "V",
    "pulse_voltage": "V",
    "mass_to_charge": "Da",
    "position_x": "nm",
    "position_y": "nm",
    "position_z": "nm",
    "detector_extent": "mm",
    "detector_quantum": "mm",
    "bin_size": "mm",
    "distance": "mm",
    "width": "mm",
    "field_of_view": "degrees",
    "field_before_leaving": "V/nm",
    "energy_limit": "eV",
    "median_residual": "mm",
    "flagged_above": "mm",
    "apex_radius": "nm",
    "height": "nm",
    "extent_x": "nm",
    "extent_y": "nm",
    "extent_z": "nm",
    "shank_length": "nm",
    "shank_angle": "degrees",
    "rotation": "degrees",
    "origin": "nm",
    "depth": "nm",
    "a": "nm",
    "c": "nm",
    "evaporation_field": "V/nm",
    "charge_state": "e",
    "mass": "Da",
    "polarizability": "F m^2",
    "voltages": "V",
    "operating_field": "V/nm",
    "duration": "s",
    "pulse_length": "s",
    "energy_scale": "eV/eV",
}
"""Units in the result of `describe`, by key."""


_OUTCOMES = ("perturbation", "hit", "missed", "never_left", "outside", "not_flown")
_MEASURED = (
    "x", "y", "time_of_flight", "voltage", "pulse_voltage", "mass_to_charge", "positions",
    "pulses", "multiplicity", "pulse_id",
)  # fmt: skip


def describe(data: Run | Hits | DetectorMap | Tip) -> dict[str, Any]:
    """Summarise a run, ions, a map or a specimen.

    Parameters
    ----------
    data : Run or Hits or DetectorMap or Tip
        Result of `apt_evap.read` or `apt_evap.read_tip`.

    Returns
    -------
    dict
        Plain types, as printed by `apt-evap info`; a pair is the smallest and the largest value. Units are in `UNITS`.
    """
    if isinstance(data, DetectorMap):
        return _of_map(data)
    if isinstance(data, Tip):
        return _of_tip(data)
    return _of_run(data) if isinstance(data, Run) else _of_hits(data)


def _of_tip(tip):
    names = [element.name for element in tip.elements]
    contents = describe_atoms(tip.positions, tip.species, names)
    if len(tip.phase_names) > 1:
        contents["atoms_above"] = describe_atoms(tip.positions, tip.phase, tip.phase_names)["atoms_above"]
    return contents | {"evaporable": int(tip.evaporable.sum())}


def describe_atoms(positions: Floats, numbers: NDArray[np.integer], names: Sequence[str]) -> dict[str, Any]:
    """Summarise the atoms of a specimen, as `describe`, from positions [nm] and numbers of their species or phases.

    ``atoms_above`` has, for each name but the first, that of the matrix, the number of all atoms that are less deep
    below the sphere of the apex, along z, than the first, a tenth and nine tenths of the atoms of this name: about the
    ions before a particle is reached, entered and passed. Not all of them hit the detector.
    """
    low, high = positions.min(axis=0), positions.max(axis=0)
    contents = {
        "kind": "specimen",
        "atoms": len(positions),
        "species": _counts(names, numbers),
        "extent_x": [_plain(low[0]), _plain(high[0])],
        "extent_y": [_plain(low[1]), _plain(high[1])],
        "extent_z": [_plain(low[2]), _plain(high[2])],
        "points_along": None,
        "height": _plain(high[2] - low[2]),
        "apex_radius": None,
        "atoms_above": {},
    }
    if len(positions) < 4 or (sphere := apex_sphere(turned := upright(positions))) is None:
        return contents
    contents["points_along"] = [round(float(part), 2) + 0.0 for part in pointing(positions)]
    contents["height"] = _plain(np.ptp(turned[:, 2]))
    contents["apex_radius"] = _plain(sphere[1])
    depth = depths(turned, *sphere)
    sorted_depths = np.sort(depth[np.isfinite(depth)])
    for number, name in enumerate(names):
        depths_of_species = depth[(numbers == number) & np.isfinite(depth)]
        if number and len(depths_of_species):
            reached = np.searchsorted(sorted_depths, np.quantile(depths_of_species, [0.0, 0.1, 0.9], method="lower"))
            contents["atoms_above"][name] = dict(
                zip(("its_first_atom", "a_tenth_of_them", "nine_tenths_of_them"), reached.tolist(), strict=True)
            )
    return contents


def _of_map(map):
    x_min, x_max, y_min, y_max = map.extent
    return {
        "kind": "detector map of counts" if map.is_counts else "detector map of densities",
        "ions": map.ions,
        "bins": list(map.values.shape[::-1]),
        "bin_size": [_plain(size) for size in map.bin_size],
        "x": [_plain(x_min), _plain(x_max)],
        "y": [_plain(y_min), _plain(y_max)],
        "values": _extent(map.values[map.mask]),
        "fraction_inside_mask": _plain(np.mean(map.mask)),
    }


def _of_run(run):
    summary = run.summary()
    responses = None
    if run.responses is not None:
        settings, residuals = run.response_settings, run.responses.residuals[np.isfinite(run.responses.residuals)]
        responses = {
            "energy_limit": settings.energy_limit,
            "median_residual": _plain(np.median(residuals)) if len(residuals) else None,
            "flagged_above": settings.bound,
            "flagged": summary["flagged"],
        }
    return {
        "kind": "simulated run",
        "version": run.provenance.get("version"),
        "created": run.provenance.get("created"),
        "config": run.provenance.get("config"),
        "fingerprint": run.fingerprint(),
        "ended": run.ended or "as planned",
        "voltage": run.voltage,
        "law": run.settings["law"],
        "clock": _clock(run),
        "real_units": _real_units(run),
        "microscope": microscope_of(run),
        "seed": run.seed,
        "tip": _tip(run.settings["tip"]),
        "detector": {"distance": run.detector.distance, "width": run.detector.width},
        "field_of_view": run.field_of_view,
        "ions": len(run),
        "species": _counts(run.elements, run.species),
        "phases": _counts(run.phase_names, run.phase),
        "field_before_leaving": _extent(run.fields),
        "outcomes": {key: summary[key] for key in _OUTCOMES if key in summary},
        "without_neighbour_to_roll_onto": summary["without_neighbour"],
        "detached": summary["detached"],
        "perturbations_flown": [
            str(plain.get("repr", plain) if isinstance(plain, dict) else plain) for plain in run.perturbations
        ],
        "responses": responses,
    }


def _counts(names, indices):
    """Number of ions by name; several species may have the same one."""
    counts = dict.fromkeys(names, 0)
    for index, name in enumerate(names):
        counts[name] += int((indices == index).sum())
    return counts


def _clock(run):
    """Voltages, duration and rate of a run with a temperature."""
    if run.clock is None:
        return None
    seconds, pulse = float(run.clock.waits.sum()), run.settings.get("pulse_length")
    rate = len(run) / seconds if seconds > 0 else 0.0
    duration = seconds if not pulse else seconds / pulse / (1e3 * run.settings["control"]["pulse_frequency"])
    return {
        "voltages": _extent(run.clock.voltages),
        "duration": _plain(duration),
        "pulse_length": pulse and _plain(pulse),
        ("ions_per_pulse" if pulse else "ions_per_second"): _plain(rate * (pulse or 1.0)),
    }


def _real_units(run):
    """Operating point of a run in real units."""
    if run.units is None:
        return None
    names = dict(enumerate(run.elements))
    charges: dict[str, int] = {}
    for species in sorted(set(run.species.tolist())):
        for charge in sorted(set(run.real.charges[run.species == species].tolist())):
            ion = f"{names[species]}{charge}+"
            charges[ion] = charges.get(ion, 0) + int(((run.species == species) & (run.real.charges == charge)).sum())
    units = run.units
    return {
        "voltages": _extent(run.instrument_voltages),
        "operating_field": _plain(units.operating_field),
        "field_reference": units.field_reference,
        "field_at_atom_over_cap": units.field_ratio and _plain(units.field_ratio),
        "energy_scale": _plain(np.median(1.0 / run.energy_scales)) if len(run) else None,
        "flight_charges": charges,
        "pulse_fraction": units.control.pulse_fraction,
    }


def microscope_of(run: Run) -> dict[str, Any] | None:
    """Lens of a run, and its radii, field factors and compressions, dict; None without a lens."""
    lens = run.observation.lens
    return (
        lens.lens_settings() | {name: _extent(figure) for name, figure in lens.figures(run.emissions.ions).items()}
        or None
    )


def real_units_line(run: Run) -> str:
    """Description of a run in real units in one line, str; "" at the simulated voltage."""
    if not (real := _real_units(run)):
        return ""
    low, high = real["voltages"] or (np.nan, np.nan)
    charges = ", ".join(f"{count:,} {name}" for name, count in real["flight_charges"].items())
    line = (
        f"real units: {low:,.4g} to {high:,.4g} V for {real['operating_field']:.3g} V/nm at the "
        f"{real['field_reference']}; {charges}; 1 eV at {run.voltage:g} V is {real['energy_scale']:.3g} eV"
    )
    microscope = microscope_of(run) if len(run) else None
    return line if microscope is None else f"{line}; {lens_text(microscope)}"


def lens_text(microscope: Mapping[str, Any]) -> str:
    """Description of the result of `microscope_of` in one line, str."""
    ends = {
        name: " to ".join(f"{value:.3g}" for value in microscope[name])
        for name in ("radius", "field_factor", "compression")
    }
    shank = f"shank of {microscope['shank_angle']:g} degrees"
    return f"lens: {shank}, R {ends['radius']} nm, k_f {ends['field_factor']}, xi {ends['compression']}"


def _tip(settings):
    """Settings of a tip without empty ones, and without the sources of the materials."""
    contents = {key: value for key, value in settings.items() if value not in (None, [], {})}
    if "material" in contents:
        host = contents["material"].items()
        contents["material"] = {key: value for key, value in host if value is not None and key != "sources"}
    if "solutes" in contents:
        contents["solutes"] = {solute["name"]: fraction for solute, fraction in contents["solutes"]}
    if "phases" in contents:
        contents["phases"] = [phase["name"] for phase in contents["phases"]]
    if "elements" in contents:
        contents["elements"] = [element["name"] for element in contents["elements"]]
    return contents


def _of_hits(hits):
    summary = _IonSummary()
    summary.add(hits)
    detected = hits.detected
    return summary.contents(None if hits.x is None or hits.y is None else (hits.x[detected], hits.y[detected]))


def describe_blocks(ions: IonBlocks) -> dict[str, Any]:
    """Summarise ions that are read block by block, as `describe`."""
    summary = ions.fed(_IonSummary)
    return summary.contents(None if ions.field is None else ions.sample)


class _IonSummary:
    """Summary of ions, all at once or block by block."""

    def __init__(self) -> None:
        self._extents: dict[str, list[Any]] = {}
        self._filled: set[str] = set()
        self._names: tuple[str, ...] = ()
        self._ions = self._detected = self._multiple = self._largest = 0
        self._places: list[list[Any]] = []
        self._first: Hits | None = None

    def add(self, hits: Hits) -> None:
        """Take the next ions."""
        if self._first is None:
            self._names, self._first = hits.columns, hits[:0]
        for name in self._names:
            values = getattr(hits, name)
            parts = {name: values} if values.ndim == 1 else _parts_of_positions(values)
            for key, part in parts.items():
                _widen(self._extents.setdefault(key, []), part)
            if name not in self._filled and (values[:64].any() or values.any()):
                self._filled.add(name)
        detected = hits.detected
        self._ions += len(hits)
        self._detected += int(np.count_nonzero(detected))
        if hits.x is not None and hits.y is not None and detected.any():
            whole = detected.all()
            self._places = self._places or [[], []]
            for extent, values in zip(self._places, (hits.x, hits.y), strict=True):
                _widen(extent, values if whole else values[detected])
        if hits.multiplicity is not None:
            self._multiple += int(np.count_nonzero(hits.multiplicity > 1))
            self._largest = max(self._largest, int(hits.multiplicity.max()))

    def contents(self, places: Sequence[Floats] | None) -> dict[str, Any]:
        """The summary, with the coordinates of the detected ions, or of a sample of them."""
        first = self._first
        assert first is not None
        measured = first.outcome is None
        contents = {"kind": "measured ions" if measured else first.source, "ions": self._ions}
        columns = {key: [_plain(low), _plain(high)] if low <= high else None for key, (low, high) in self._ends()}
        contents |= {"detected": self._detected, "columns": columns}
        if measured:
            contents["absent_or_zero_throughout"] = [name for name in _MEASURED if name not in self._filled]
        if self._places and places is not None:
            contents["detector_extent"] = [_plain(high - low) for low, high in self._places]
            quantisations = find_quantisations(*places)
            contents["detector_quantum"] = (
                None if quantisations is None else [_plain(quantisation.spacing) for quantisation in quantisations]
            )
        if "multiplicity" in self._names:
            contents["multi_hit_share"] = _plain(self._multiple / self._ions)
            contents["largest_multi_hit"] = self._largest
        return contents

    def _ends(self):
        return ((key, extent or (1, 0)) for key, extent in self._extents.items())


def _parts_of_positions(values):
    return {f"position_{axis}": values[:, k] for k, axis in enumerate("xyz")}


def _widen(extent, values):
    """Widen an extent, of two numbers, by the finite ones of some values."""
    if not len(values):
        return
    low, high = values.min(), values.max()
    if not (np.isfinite(low) and np.isfinite(high)):
        values = values[np.isfinite(values)]
        if not len(values):
            return
        low, high = values.min(), values.max()
    extent[:] = (min(low, extent[0]), max(high, extent[1])) if extent else (low, high)


def _extent(values):
    """Smallest and largest finite value, None if there is none."""
    extent: list[Any] = []
    _widen(extent, values)
    return [_plain(end) for end in extent] or None


def _plain(value):
    """Number with six digits; integers unchanged."""
    return int(value) if isinstance(value, np.integer) else float(f"{value:.6g}") + 0.0
