"""Field-ion image of an emitter: where and how brightly each surface atom shows in a field ion microscope.

Atoms of the imaging gas are ionised where the highest occupied level of the gas is at the Fermi level of the specimen:
on the critical surface, about half a nanometre outside. The probability is that of an electron that tunnels through the
barrier in the field there. The ions then fly to the screen.
"""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass, field
from types import MappingProxyType
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from apt_evap._common.ion_random import IonRandom
from apt_evap._common.types import Booleans, Floats, Integers
from apt_evap._common.validation import (
    check_choice,
    check_count,
    check_kind,
    check_name,
    check_number,
    check_seed,
    check_values,
    short_text,
)
from apt_evap.detection.detector import Detector
from apt_evap.detection.detector_map import DetectorMap
from apt_evap.detection.hits import Hits, Outcome
from apt_evap.detection.projection import polar_angles
from apt_evap.evaporation.emitter import Emitter
from apt_evap.simulation.flight.flight_pool import FlightSettings, check_reach, fly_at_rest
from apt_evap.simulation.flight.landing import land
from apt_evap.units import BOLTZMANN

SUPPLIES = ("constant", "capture")
"""Supply of gas to the critical surface: the same everywhere, or in proportion to the square of the field."""

TUNNELLING = ("barrier", "local")
"""Field of the tunnel factor: the mean between an atom and the critical surface, or that on this surface."""

_TUNNEL = 6.831  # 4 sqrt(2 m) / (3 e hbar) [V/nm eV^-3/2]: Gomer, Field Emission and Field Ionization (1961)
_IMAGE = 2.400  # 2 sqrt(e / 4 pi eps0) [eV (nm/V)^1/2]: image potential at the barrier, same source
_WORK_FUNCTION = 4.5  # eV, of tungsten; 0.5 eV more reduce the critical distance by 3 %
_SPOT = 0.15  # nm: spot at 0 K, of the size of the gas atom (Mueller and Tsong, Field Ion Microscopy, 1969)
_SPREAD = 16.0  # of the thermal term of the spot, same source
_INSIDE = 4.0  # d_nn below an atom: its lattice changes the potential there by less than 1e-4 of the barrier
_CLOSEST, _FARTHEST = 0.15, 2.0  # nm: the critical distance is 0.46 to 0.51 nm at best image fields
_STEPS = 12  # of Newton; 3 to 5 are needed
_CONVERGED = 1e-4  # of the barrier: 5e-5 nm
_FAINTEST = 1e-4  # of the brightest atom: fainter ones are not flown
_NEAR = math.radians(45)  # atoms within this angle define the magnification
_FWHM = 2 * math.sqrt(2 * math.log(2))  # of a Gaussian in standard deviations


@dataclass(frozen=True)
class ImagingGas:
    """Gas of a field ion microscope.

    Parameters
    ----------
    name : str
        Name.
    ionisation_energy : float
        First ionisation energy [eV].
    field : float
        Best image field [V/nm].
    """

    name: str
    ionisation_energy: float
    field: float

    def __post_init__(self):
        check_name(self.name, "name")
        check_number(self.ionisation_energy, "ionisation_energy", above=0, unit="eV")
        check_number(self.field, "field", above=0, unit="V/nm")


# ionisation energies: NIST Atomic Spectra Database; best image fields: Mueller and Tsong, Field Ion Microscopy (1969)
_GASES = (("He", 24.587, 44.0), ("Ne", 21.565, 35.0), ("Ar", 15.760, 22.0), ("H2", 15.426, 22.0))
GASES = MappingProxyType({name: ImagingGas(name, energy, field) for name, energy, field in _GASES})
"""Imaging gases by name."""


def tunnel_factor(field: ArrayLike, ionisation_energy: float) -> Any:
    r"""Probability that an electron tunnels from a gas atom at the critical distance into the specimen.

    Parameters
    ----------
    field : float or array_like
        Field [V/nm], > 0.
    ionisation_energy : float
        Ionisation energy of the gas [eV].

    Returns
    -------
    float or ndarray
        Of the shape of `field`. 1 if the field removes the barrier.

    Notes
    -----
    .. math:: D = \exp\left[-\frac{6.831 \, I^{3/2}}{F} \sqrt{1 - 2.40 \, \sqrt{F} / I}\right]

    with F in V/nm and I in eV (Gomer, Field Emission and Field Ionization, 1961).

    Examples
    --------
    Five per cent of the field of neon are a factor of 2.2 of the brightness:

    >>> from apt_evap.simulation.ion_image import tunnel_factor
    >>> tunnel = tunnel_factor
    >>> round(tunnel(1.05 * 35.0, 21.565) / tunnel(35.0, 21.565), 1)
    2.2
    """
    fields = check_values(field, "field")
    if not (fields > 0).all():
        raise ValueError(f"field must be > 0 V/nm, got {short_text(field)}")
    energy = check_number(ionisation_energy, "ionisation_energy", above=0, unit="eV")
    barrier = np.sqrt(np.maximum(1 - _IMAGE * np.sqrt(fields) / energy, 0.0))
    factors = np.exp(-_TUNNEL * energy**1.5 / fields * barrier)
    return float(factors) if factors.ndim == 0 else factors


@dataclass(frozen=True, eq=False)
class FieldIonImage:
    """Field-ion image: the spots of the n surface atoms that an image shows.

    Parameters
    ----------
    atoms : ndarray of int, shape (n,)
        Index of each atom in the specimen.
    positions : ndarray, shape (n, 3)
        Positions of the atoms [nm].
    starts : ndarray, shape (n, 3)
        Place on the critical surface above each atom [nm]; NaN if there is none.
    fields : ndarray, shape (n,)
        Field of the tunnel factor [V/nm]; NaN without such a place.
    brightness : ndarray, shape (n,)
        Ions per time from each atom, relative to a place whose field is the best image field; 0 without a place.
    x, y : ndarray, shape (n,)
        Centre of each spot on the detector [mm]; NaN for an atom that is too faint, or whose ions miss it.
    spot : float
        Full width at half maximum of a spot on the specimen [nm].
    magnification : float
        Distance on the detector per distance on the specimen, at the centre [mm/nm].
    voltage : float
        Voltage of the image [V], of the model without a counter electrode.
    detector : Detector
        The detector.
    settings : mapping
        Gas and constants of the image.
    """

    atoms: Integers = field(repr=False)
    positions: Floats = field(repr=False)
    starts: Floats = field(repr=False)
    fields: Floats = field(repr=False)
    brightness: Floats = field(repr=False)
    x: Floats = field(repr=False)
    y: Floats = field(repr=False)
    spot: float
    magnification: float
    voltage: float
    detector: Detector
    settings: Any = field(repr=False)

    def __len__(self) -> int:
        return len(self.atoms)

    def __repr__(self) -> str:
        return (
            f"<FieldIonImage: {np.count_nonzero(self.shown):,} spots of {len(self):,} surface atoms in "
            f"{self.settings['gas']['name']} at {self.voltage:.4g} V, {self.magnification:.3g} mm/nm>"
        )

    @property
    def shown(self) -> Booleans:
        """Atoms with a spot on the detector, bool of shape (n,)."""
        return np.isfinite(self.x) & (self.brightness > 0)

    @property
    def distances(self) -> Floats:
        """Distance of the critical surface from each atom [nm], shape (n,); NaN if there is none."""
        return np.linalg.norm(self.starts - self.positions, axis=1)

    def map(self, bins: int = 256, extent: float | None = None) -> DetectorMap:
        """Brightness on the detector, each spot a Gaussian.

        Parameters
        ----------
        bins : int
            Number of bins along each side.
        extent : float, optional
            Edge of the square [mm]; by default the width of the detector.

        Returns
        -------
        DetectorMap
            Brightness per mm^2.
        """
        bins = check_count(bins, "bins", at_least=2, at_most=8192)
        width = self.detector.width if extent is None else check_number(extent, "extent", above=0, unit="mm")
        edges = np.linspace(-width / 2, width / 2, bins + 1)
        chosen = self.shown
        values = np.histogram2d(self.y[chosen], self.x[chosen], (edges, edges), weights=self.brightness[chosen])[0]
        gas = self.settings["gas"]["name"]
        image = DetectorMap.from_array(
            values / (edges[1] - edges[0]) ** 2, edges, edges, source=f"field-ion image, {gas}"
        )
        return image.smoothed(self.spot / _FWHM * self.magnification)

    def hits(self, n: int, seed: int = 0) -> Hits:
        """Draw gas ions.

        Parameters
        ----------
        n : int
            Number of ions.
        seed : int
            Seed of the random numbers; an ion depends on this and its number only.

        Returns
        -------
        Hits
            With the columns x, y, `site` (the atom below), `ion` and `outcome`.

        Raises
        ------
        ValueError
            If no atom is shown.
        """
        ions = np.arange(check_count(n, "n", at_least=1))
        random = IonRandom(check_seed(seed), ions)
        shown = np.flatnonzero(self.shown)
        if not len(shown):
            raise ValueError(f"{self!r} shows no atom")
        total = np.cumsum(self.brightness[shown])
        place = np.searchsorted(total, random.uniform()[:, 0] * total[-1], side="right")
        atom = shown[np.minimum(place, len(shown) - 1)]
        away = random.normal(2) * (self.spot / _FWHM * self.magnification)
        x, y = self.x[atom] + away[:, 0], self.y[atom] + away[:, 1]
        outside = (np.abs(x) > self.detector.width / 2) | (np.abs(y) > self.detector.width / 2)
        outcome = np.where(outside, Outcome.MISSED, Outcome.HIT).astype(np.int8)
        source = f"field-ion image, {self.settings['gas']['name']}"
        return Hits(
            x=x, y=y, site=self.atoms[atom], ion=ions, outcome=outcome, source=source, extent=self.detector.extent
        )


def field_ion_image(
    emitter: Emitter,
    gas: str | ImagingGas = "Ne",
    *,
    image_field: float | None = None,
    voltage: float | None = None,
    tunnelling: str = "barrier",
    supply: str = "constant",
    work_function: float = _WORK_FUNCTION,
    temperature: float = 20.0,
    half_angle: float = 60.0,
    detector: Detector | None = None,
    flight_settings: FlightSettings | None = None,
) -> FieldIonImage:
    r"""Field-ion image of the present surface of an emitter.

    Parameters
    ----------
    emitter : Emitter
        The surface; it does not change.
    gas : str or ImagingGas
        "He", "Ne", "Ar", "H2", or another gas.
    image_field : float, optional
        Mean field of the cap [V/nm]; by default the best image field of the gas.
    voltage : float, optional
        Voltage in place of `image_field` [V].
    tunnelling : str
        Field of the tunnel factor: "barrier", the mean between the atom and the critical surface, or "local", that on
        this surface.
    supply : str
        Supply of gas: "constant", or "capture" in proportion to :math:`F^2`, the polarisation energy.
    work_function : float
        Work function of the specimen [eV].
    temperature : float
        Temperature of the gas at its ionisation [K], for the size of the spots.
    half_angle : float
        Atoms up to this angle from the axis are imaged [degrees].
    detector : Detector, optional
        The screen; by default a plane at 100 mm with a width of 300 mm.
    flight_settings : FlightSettings, optional
        Accuracy of the flights of the gas ions.

    Returns
    -------
    FieldIonImage

    Raises
    ------
    ValueError
        If an argument is outside its range, no atom is within the angle, or the field of the cap is not known.

    Notes
    -----
    The critical surface has the potential of the specimen minus :math:`(I-\varphi)/e`. Above each atom it is found
    along the normal by Newton's method. The potential of the specimen is taken four neighbour distances below the
    atom: for exact charges it is the applied voltage, and Robin's charges differ from this by up to 1 % locally.

    The brightness is the supply times the `tunnel_factor`. This is the formula for a uniform field. Above a protruding
    atom the field is high near the atom and lower outside: the barrier is thinner, although the field on the critical
    surface is nearly the same everywhere. The mean field of the barrier, :math:`(I-\varphi)/z_c` at the distance
    :math:`z_c`, contains this. Measured on Ni[111], R = 7 nm, in neon: atoms with 6, 7 and 9 bonds around the pole have
    3.3, 1.6 and 0.08 of the brightness at the best image field; with the local field 0.14, 0.13 and 0.12.

    Each ion is flown from rest, with charge
    1, in the field of the charges. The width of a spot on the specimen is :math:`\delta^2 = \delta_0^2 + 16 \, k T R /
    F`, with :math:`\delta_0` = 0.15 nm, and the radius R and mean field F of the cap (Müller and Tsong, Field Ion
    Microscopy, 1969). On the detector all spots have the same width.
    """
    check_kind(emitter, "emitter", Emitter, "an Emitter, such as simulation.emitter")
    gas = GASES[check_choice(gas, "gas", tuple(GASES))] if isinstance(gas, str) else gas
    check_kind(gas, "gas", ImagingGas, "He, Ne, Ar, H2 or an ImagingGas")
    check_choice(tunnelling, "tunnelling", TUNNELLING)
    check_choice(supply, "supply", SUPPLIES)
    barrier = _barrier(gas.ionisation_energy, work_function)
    temperature = check_number(temperature, "temperature", at_least=0, at_most=1000, unit="K")
    angle = math.radians(check_number(half_angle, "half_angle", above=0, at_most=90, unit="degrees"))
    detector = Detector() if detector is None else check_kind(detector, "detector", Detector, "a Detector")
    settings = FlightSettings() if flight_settings is None else flight_settings
    check_kind(settings, "flight_settings", FlightSettings, "FlightSettings")
    check_reach(settings, emitter.tip, detector)
    scale, cap_field, radius = _scale_of(emitter, gas, image_field, voltage)

    # surface atoms within the angle about the axis
    tip, centre = emitter.tip, emitter.tip.potential_point
    chosen = tip.evaporable[emitter.atoms] & (polar_angles(emitter.positions - centre) <= angle)
    if not chosen.any():
        raise ValueError(f"half_angle must include surface atoms that can evaporate, got {half_angle:g} degrees")
    atoms, positions, normals = (values[chosen] for values in (emitter.atoms, emitter.positions, emitter.normals))

    # critical surface: potential of the specimen minus (I - phi) / e; the field of the barrier is (I - phi) / z_c
    inside = positions - _INSIDE * tip.nearest_neighbour_distance * normals
    level = scale * emitter.potential_at(inside) - barrier
    starts, local = _critical_surface(emitter, positions, normals, level, scale, barrier)
    fields = local if tunnelling == "local" else barrier / np.linalg.norm(starts - positions, axis=1)

    brightness = _brightness(gas, supply, fields, local)

    # spots on the detector, by flights of the ions from the critical surface
    flown = brightness > _FAINTEST * brightness.max()
    x, y = np.full((2, len(atoms)), np.nan)
    x[flown], y[flown] = _spots(emitter, starts[flown], settings, detector)
    constants = {
        "gas": asdict(gas),
        "image_field": cap_field,
        "tunnelling": tunnelling,
        "supply": supply,
        "work_function": float(work_function),
        "temperature": temperature,
        "half_angle": float(half_angle),
    }
    return FieldIonImage(
        atoms=atoms,
        positions=positions,
        starts=starts,
        fields=fields,
        brightness=brightness,
        x=x,
        y=y,
        spot=math.sqrt(_SPOT**2 + _SPREAD * BOLTZMANN * temperature * radius / cap_field),
        magnification=_magnification(starts - centre, x, y, detector, radius),
        voltage=emitter.voltage * scale,
        detector=detector,
        settings=constants,
    )


def _brightness(gas, supply, fields, local):
    """Tunnel factor relative to that at the best image field, times the supply of gas; 0 where it is not known."""
    known = np.isfinite(fields)
    brightness = np.zeros(len(fields))
    best = tunnel_factor(gas.field, gas.ionisation_energy)
    brightness[known] = tunnel_factor(fields[known], gas.ionisation_energy) / best
    if supply == "capture":
        brightness[known] *= (local[known] / gas.field) ** 2
    return brightness


def _barrier(ionisation_energy, work_function):
    """I - phi [eV]."""
    energy = check_number(ionisation_energy, "ionisation_energy", above=0, unit="eV")
    function = check_number(work_function, "work_function", above=0, unit="eV")
    if function >= energy:
        raise ValueError(
            f"work_function must be below the ionisation energy of the gas, {energy:g} eV, got {function:g}"
        )
    return energy - function


def _scale_of(emitter, gas, image_field, voltage):
    """Factor of the fields of the emitter, mean field [V/nm] and radius [nm] of the cap."""
    cap = emitter.cap
    if not math.isfinite(cap.field):
        raise ValueError(f"{emitter!r} has too few surface atoms about its axis: the field of its cap is not known")
    if voltage is not None:
        if image_field is not None:
            raise ValueError(f"image_field and voltage exclude each other, got {image_field} V/nm and {voltage} V")
        scale = check_number(voltage, "voltage", above=0, unit="V") / emitter.voltage
        return scale, scale * cap.field, cap.radius
    field_needed = gas.field if image_field is None else check_number(image_field, "image_field", above=0, unit="V/nm")
    return field_needed / cap.field, field_needed, cap.radius


def _critical_surface(emitter, positions, normals, level, scale, barrier):
    """Places where the potential has its critical value, along the normals, and the fields there."""
    outward = scale * emitter.cap.field
    distance = np.full(len(positions), barrier / outward)
    starts, fields = np.full((len(positions), 3), np.nan), np.full(len(positions), np.nan)
    active = np.arange(len(positions))
    for _ in range(_STEPS):
        points = positions[active] + distance[active, None] * normals[active]
        excess = scale * emitter.potential_at(points) - level[active]
        vectors = scale * emitter.field_at(points)
        done = np.abs(excess) < _CONVERGED * barrier
        starts[active[done]] = points[done]
        fields[active[done]] = np.linalg.norm(vectors[done], axis=1)
        slope = np.einsum("ij,ij->i", vectors, normals[active])
        with np.errstate(divide="ignore", invalid="ignore"):
            # half the way at most towards the atom, whose potential is infinite
            step = np.maximum(excess / slope, -distance[active] / 2)
        distance[active] += step
        ahead = (slope > 0) & (distance[active] > _CLOSEST) & (distance[active] < _FARTHEST)
        active = active[~done & ahead]
        if not len(active):
            break
    return starts, fields


def _spots(emitter, starts, settings, detector):
    """Detector coordinates of gas ions [mm]; NaN for those that miss it."""
    ends = fly_at_rest(emitter, starts, settings)
    directions, times = land(ends, np.ones(len(starts)), detector, emitter.tip.apex)
    x, y, _, outcome = detector.impacts(directions[:, 0], times[:, 0])
    hit = outcome == Outcome.HIT
    return np.where(hit, x, np.nan), np.where(hit, y, np.nan)


def _magnification(from_centre, x, y, detector, radius):
    """Distance on the detector per distance on the specimen at the centre [mm/nm]."""
    angles = polar_angles(from_centre)
    near = np.isfinite(x) & (angles < _NEAR)
    if not near.any():
        return math.nan
    seen = detector.seen_from_apex.angles(np.column_stack([x, y])[near])
    return detector.distance * float(seen @ angles[near] / (angles[near] @ angles[near])) / radius
