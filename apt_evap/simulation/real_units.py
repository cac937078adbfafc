"""A run in real units: voltages, charges and masses of its ions in flight, and the pulses in which they left.

Charges, fields and potentials of a simulated surface are proportional to the applied voltage, and the path of an ion
depends on E / (n V) only, with its start energy E along the surface and its charge n. So a run at any voltage is the
same run at the voltage of an experiment, with scaled energies and times: no flight is repeated.
"""

from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from apt_evap._common.codec import checked, choice, count, from_plain, number, part, settings
from apt_evap._common.ion_random import IonRandom
from apt_evap._common.types import Floats, Integers
from apt_evap._common.validation import check_count, check_seed, short_text
from apt_evap._core.elementary import logarithm, total
from apt_evap.detection.microscope.free_specimen import FreeSpecimen
from apt_evap.detection.timing import Timing
from apt_evap.emission.post_ionisation import FLIGHT_CHARGES, PostIonisation
from apt_evap.evaporation.cap import doubt_of_cap
from apt_evap.evaporation.voltage import VoltageControl
from apt_evap.simulation.history import CapHistory
from apt_evap.specimen.isotopes import draw_isotopes

REFERENCES = ("cap", "site")
SAME_PULSE = 0.01  # an atom whose field exceeds the control level by 1 % leaves in the pulse of the one before
_SEED_STEP = 0x5851F42D4C957F2D  # other random numbers than those of the perturbations
_COLUMNS = 5  # random numbers per ion: isotope, charge, pulse, energy deficit, delay


def _flight_charges(charges, name):
    """Charges in flight: one for all, by element (checked with the elements of a run), or `PostIonisation`."""
    return charges if isinstance(charges, PostIonisation | Mapping) else check_count(charges, name, at_least=1)


def _read_flight_charges(plain, name):
    drawn = isinstance(plain, Mapping) and "name" in plain
    return from_plain(plain, PostIonisation, what=name) if drawn else plain


@settings
class OperatingPoint:
    """Arguments of `Run.at_evaporation_field`, and the table ``[real_units]`` of a settings file."""

    field_reference: str = choice(
        '"cap": the mean field of the cap is the operating field. Literature evaporation fields are such means, as '
        'they are determined as V / (k_f R). "site": the field at the evaporating atom, which is about 1.4 times '
        "higher, is the operating field.",
        REFERENCES,
        default="cap",
    )
    operating_field: float | None = number(
        "Operating field of the host. By default its evaporation field; for a law with a temperature, the field to "
        "which the control led.",
        default=None,
        above=0,
        at_most=1000,
        unit="V/nm",
    )
    flight_charges: int | Mapping[str, int] | PostIonisation | None = checked(
        "Charge of the ions in flight, for all ions or by element; `PostIonisation` draws it from the local field. By "
        "default that of the main peak in usual spectra, such as 2 for Ni. It is not the charge at the barrier, which "
        "defines the evaporation field.",
        "int or mapping or PostIonisation",
        _flight_charges,
        default=None,
        read=_read_flight_charges,
        hash=False,
    )
    control: VoltageControl | None = part(
        "Rate and pulses; by default those of the run, or `VoltageControl()`.", VoltageControl, default=None
    )
    timing: Timing | None = part(
        "Errors of the times of flight, so that `Hits.mass_to_charge` is a spectrum; by default the times are exact.",
        Timing,
        default=None,
    )
    smoothing: int = count(
        "Number of ions over which the voltage is averaged, as by the control of an instrument.",
        default=250,
        at_least=1,
    )
    field_factor: float | None = number(
        "k_f of the instrument, V = k_f F R, with the initial apex radius R. The reported voltages are then those of "
        "the instrument, the ratio of both factors is constant. By default they follow from the lens; without a lens "
        "they are those of the model, whose field factor is smaller because it has no counter electrode.",
        default=None,
        at_least=0.1,
        at_most=100,
    )
    seed: int | None = checked(
        "Seed of isotopes, charges, pulses and times; by default that of the run.", "int", check_seed, default=None
    )


@settings
class RealUnits:
    """Operating point and instrument of a run in real units; made by `Run.at_evaporation_field`."""

    field_reference: str = choice(
        "What is at the operating field: the mean over the cap, or the evaporating atom.", REFERENCES
    )
    operating_field: float = number("Operating field of the host.", above=0, at_most=1000, unit="V/nm")
    field_ratio: float | None = number(
        "Field at the evaporating atoms divided by the mean field of the cap; None without a history of the cap.",
        default=None,
        above=0,
    )
    smoothing: int = count("Number of ions over which the voltage is averaged.", default=1, at_least=1)
    control: VoltageControl = part("Rate and pulses.", VoltageControl, default=VoltageControl())
    timing: Timing | None = part("Errors of the times of flight.", Timing, default=None)
    seed: int = checked("Seed of isotopes, charges, pulses and times.", "int", check_seed, default=0)


class RealColumns(NamedTuple):
    """Columns of a run in real units, each of shape (n,)."""

    voltages: np.ndarray
    """Voltage that accelerates each ion, V_dc + V_p [V], in the model."""
    instrument_voltages: np.ndarray
    """The same in the instrument [V], by the lens or the field factor; without both, that of the model."""
    charges: np.ndarray
    """Charge in flight [e], int32."""
    masses: np.ndarray
    """Mass of the isotope [Da]."""
    pulse_ids: np.ndarray
    """Number of the pulse, int64."""

    def __repr__(self) -> str:
        return f"<RealColumns: {len(self.voltages):,} ions>"


def random_of(seed: int, ions: Integers) -> Floats:
    """Random numbers of ions for isotope, charge, pulse, energy deficit and delay, shape (n, 5)."""
    return IonRandom((seed + _SEED_STEP) % (1 << 64), ions).uniform(_COLUMNS)


def _mean(values):
    return total(values) / len(values) if len(values) else np.nan


def trailing_mean(values: Floats, n: int) -> Floats:
    """Mean of each value and its n - 1 predecessors; of all predecessors for the first ones."""
    if n == 1:
        return values
    total = np.concatenate([[0.0], np.cumsum(values)])
    end = np.arange(1, len(values) + 1)
    begin = np.maximum(end - n, 0)
    return (total[end] - total[begin]) / (end - begin)


def real_voltages(
    site_ratios: Floats,
    cap: CapHistory,
    ions: Integers,
    voltage: float,
    controlled: Floats | None,
    field_reference: str,
    operating_ratio: float | None,
    smoothing: int,
) -> tuple[Floats, float, float | None]:
    """Voltage of every ion such that the cap, or the evaporating atom, is at the operating field.

    Parameters
    ----------
    site_ratios : ndarray, shape (n,)
        Field of each atom before evaporation, over its evaporation field, at the simulated voltage.
    cap : CapHistory
        The cap after each relaxation.
    ions : ndarray of int64, shape (n,)
        Numbers of the ions.
    voltage : float
        Simulated voltage [V].
    controlled : ndarray or None
        Voltages of a `VoltageControl` during the run, shape (n,).
    field_reference : {"cap", "site"}
        See `RealUnits`.
    operating_ratio : float or None
        Operating field over evaporation field; None for 1, or for what the control of the run led to.
    smoothing : int
        Number of ions over which a voltage is averaged.

    Returns
    -------
    voltages : ndarray, shape (n,)
        [V].
    operating_ratio : float
        The operating field over the evaporation field.
    field_ratio : float or None
        Field at the evaporating atoms divided by the mean field of the cap; None without a history of the cap.
    """
    known = np.isfinite(cap.ratios)
    cap_ratios = np.full(len(ions), np.nan)
    if known.any():
        cap_ratios = np.interp(ions, cap.ions[known], cap.ratios[known])
    elif field_reference == "cap":
        raise ValueError(
            "field_reference 'cap' needs the mean field of the cap, which this run does not contain: too few of "
            "its surface atoms are around the axis; use field_reference='site'"
        )
    field_ratio = _mean(site_ratios / cap_ratios) if known.any() and len(ions) else None
    ratios = cap_ratios if field_reference == "cap" else site_ratios
    if controlled is None:
        goal = 1.0 if operating_ratio is None else operating_ratio
        return trailing_mean(voltage * goal / ratios, smoothing), goal, field_ratio
    reached = _mean(site_ratios * controlled) / voltage
    goal = reached if operating_ratio is None else operating_ratio
    scale = goal / (_mean(ratios * controlled) / voltage)
    return trailing_mean(scale * controlled, smoothing), goal, field_ratio


def check_flight_charges(flight_charges: Any, names: tuple[str, ...]) -> dict[str, int] | PostIonisation:
    """Return charges in flight by element, or how they are drawn.

    They are the usual charges of the elements (`FLIGHT_CHARGES`), one charge for all ions, charges by element, or
    charges drawn from the local field.
    """
    if isinstance(flight_charges, PostIonisation):
        return flight_charges
    if flight_charges is None:
        return {name: FLIGHT_CHARGES[name] for name in names if name in FLIGHT_CHARGES}
    if not isinstance(flight_charges, Mapping):
        return dict.fromkeys(names, check_count(flight_charges, "flight_charges", at_least=1))
    for name in flight_charges:
        if name not in names:
            raise ValueError(f"flight_charges must be of the elements {', '.join(names)}, got {short_text(name)}")
    return {name: check_count(n, f"flight_charges of {name}", at_least=1) for name, n in flight_charges.items()}


def flight_charges_of(
    flight_charges: dict[str, int] | PostIonisation,
    names: tuple[str, ...],
    species: Integers,
    barrier_charges: Integers,
    fields: Floats,
    u: Floats,
) -> NDArray[np.int32]:
    """Charge of each ion in flight [e], int (n,), by the result of `check_flight_charges`.

    Other elements keep the charge at the barrier. `fields` are those at each evaporation [V/nm], `u` random numbers in
    (0, 1).
    """
    if isinstance(flight_charges, PostIonisation):
        least = np.ones(len(names), np.int64)
        least[species] = barrier_charges
        return flight_charges.draw(names, species, least, fields, u)
    charges = np.array(barrier_charges, np.int32)
    for index, name in enumerate(names):
        if name in flight_charges:
            charges[species == index] = flight_charges[name]
    return charges


def pulses_of(excess: Floats, rate: float, u: Floats) -> Integers:
    """Number of the pulse of each ion of a run without a clock, int64 (n,), at a rate of ions per pulse.

    `excess` is the field of each atom before evaporation, relative to the level of the control. An atom that exceeds
    the level by 1 % leaves in the pulse of the one before, because it was there already. All others wait a geometric
    number of pulses, by random numbers `u` in (0, 1).
    """
    n = len(excess)
    if n == 0:
        return np.empty(0, np.int64)
    same = excess > 1.0 + SAME_PULSE
    same[0] = False
    probability = min(rate * np.count_nonzero(~same) / n, 0.999999)
    waits = np.ceil(logarithm(u) / logarithm(1.0 - probability))
    return np.cumsum(np.where(same, 0.0, np.maximum(waits, 1.0))).astype(np.int64)


def isotopes_of(names: tuple[str, ...], species: Integers, masses: Floats, u: Floats) -> Floats:
    """Mass of the isotope of each ion [Da], shape (n,); the mass of the run for elements without a table."""
    by_species = np.ones(len(names))
    by_species[species] = masses
    return draw_isotopes(names, species, by_species, u)


def real_units_of(run: Any, point: OperatingPoint) -> tuple[RealUnits, RealColumns]:
    """Operating point and columns of a run in real units, see `Run.at_evaporation_field`."""
    tip, emissions, evaporation_fields = run.settings["tip"], run.emissions, run.evaporation_fields
    control = point.control
    if control is None:
        stored = run.settings["control"]
        control = from_plain(stored, VoltageControl) if stored else VoltageControl()
    seed = run.seed if point.seed is None else point.seed
    given_charges = check_flight_charges(point.flight_charges, run.elements)
    if point.field_reference == "cap" and len(run.cap.ions) and run.cap.ions[0] == 0:
        radius = float(run.cap.radii[0])  # of the tip before its first event; without one, later caps are used
        if np.isfinite(radius) and (doubt := doubt_of_cap(radius, tip.get("apex_radius"))):
            raise ValueError(doubt)
    host_field = (tip["material"] if "material" in tip else tip["elements"][0])["evaporation_field"]
    voltages, goal, field_ratio = real_voltages(
        run.fields / evaporation_fields,
        run.cap,
        emissions.ions,
        run.voltage,
        None if run.clock is None else run.clock.voltages,
        point.field_reference,
        None if point.operating_field is None else point.operating_field / host_field,
        point.smoothing,
    )
    u = random_of(seed, emissions.ions)
    # fields at the evaporations, about their mean, which is the operating field
    local = run.fields * voltages / evaporation_fields
    local = local / (_mean(local) or 1.0) * goal if len(run) else local
    fields = local * evaporation_fields
    operating_field = goal * host_field
    real = RealColumns(
        voltages=voltages,
        instrument_voltages=_instrument_voltages(run, point.field_factor, voltages, operating_field),
        charges=flight_charges_of(given_charges, run.elements, run.species, emissions.charge_states, fields, u[:, 1]),
        masses=isotopes_of(run.elements, run.species, emissions.masses, u[:, 0]),
        pulse_ids=_pulse_ids(run, control, local / goal, u[:, 2]),
    )
    units = RealUnits(
        field_reference=point.field_reference,
        operating_field=operating_field,
        field_ratio=field_ratio,
        smoothing=point.smoothing,
        control=control,
        timing=point.timing,
        seed=seed,
    )
    return units, real


def _instrument_voltages(run, field_factor, voltages, operating_field):
    """Voltages of an instrument with a lens or a field factor, from those of the model."""
    lens = run.lens or FreeSpecimen()
    if field_factor is None:
        return lens.voltages(voltages, run.emissions.ions, operating_field)
    lens.check_field_factor(field_factor)
    radius = run.settings["tip"].get("apex_radius")
    if radius is None:
        raise ValueError("field_factor needs the apex radius, which a tip made from positions does not have")
    return voltages * (field_factor * operating_field * radius / float(voltages[0]) if len(voltages) else 1.0)


def _pulse_ids(run, control, excess, u):
    """Number of the pulse of each ion: from the clock, or drawn for the rate, or without pulses its own."""
    pulse_length = run.settings["pulse_length"]
    if run.clock is not None and pulse_length:
        return np.floor(np.cumsum(run.clock.waits) / pulse_length).astype(np.int64)
    if run.clock is not None or control.pulse_fraction == 0:
        return np.arange(len(run))
    return pulses_of(excess, control.rate, u)
