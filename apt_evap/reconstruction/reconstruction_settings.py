"""Settings of a reconstruction: protocol, projection and constants."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from apt_evap._common.codec import changed, checked, choice, count, from_plain, number, part, settings, to_plain
from apt_evap._common.validation import check_array, check_choice, check_kind, check_number, short_text
from apt_evap.detection.microscope.local_electrode import LocalElectrode
from apt_evap.specimen.lattice import atom_density
from apt_evap.specimen.materials import Material, as_material

PROTOCOLS = ("cap", "bas")
"""Depth increments: of the spherical cap, exact; with the area of the detector, of Bas et al."""

PROJECTIONS = ("bas", "equidistant", "compressed")
"""Relations between the distance on the detector and the angle on the cap."""

_FIELD_FACTOR = 3.3
_COMPRESSION = 1.5
_NEEDS = {"voltage": ("evaporation_field",), "shank": ("initial_radius", "shank_angle")}  # of each word for the radius


def _protocol(value, name):
    if value == "geiser":
        raise ValueError(
            f'{name} must be "cap" or "bas", got "geiser": public descriptions of wide-angle increments are that of '
            '"cap", and no different one was found'
        )
    return check_choice(value, name, PROTOCOLS)


def _radius(value, name):
    """A word, a radius, or an array of radii, of which nothing can be changed."""
    if isinstance(value, str):
        return check_choice(value, name, tuple(_NEEDS))
    if np.ndim(value) == 0:
        return check_number(value, name, above=0, unit="nm")
    radii = check_array(value, name, ("n",)).copy()
    if len(radii) and radii.min() <= 0:
        raise ValueError(f"{name} must be > 0 nm, got {radii.min():g}")
    radii.flags.writeable = False
    return radii


@settings
class ReconstructionSettings:
    """Settings of `reconstruct`: protocol, projection and constants.

    Examples
    --------
    >>> settings = ae.reconstruction.ReconstructionSettings(distance=90.0, element="Al", efficiency=0.57)
    >>> known = settings.resolved()
    >>> print(f"{known.atomic_volume:.4f} nm^3, {known.evaporation_field:g} V/nm, xi = {known.compression:g}")
    0.0166 nm^3, 19 V/nm, xi = 1.5
    """

    distance: float = number("Flight length; of an instrument with a reflectron the virtual one.", above=0, unit="mm")
    element: Material | str | None = checked(
        "Material of the specimen, from which `atomic_volume` and `evaporation_field` are taken.",
        "Material or str",
        as_material,
        default=None,
        read=as_material,
    )
    atomic_volume: float | None = number(
        "Mean volume per ion in the specimen. By default that of the element.", default=None, above=0, unit="nm^3"
    )
    evaporation_field: float | None = number(
        'F in V = k_f F R, for ``radius="voltage"``. By default that of the element.',
        default=None,
        above=0,
        unit="V/nm",
    )
    field_factor: float | None = number(
        'k_f in V = k_f F R, for ``radius="voltage"``. By default 3.3.', default=None, at_least=0.1, at_most=100
    )
    compression: float | None = number("Image compression xi. By default 1.5.", default=None, above=0)
    projection: str | None = choice(
        'Relation of places on the detector to angles on the cap. See `reconstruct`. By default "bas".',
        PROJECTIONS,
        default=None,
    )
    efficiency: float = number("Fraction of the ions that the detector detects.", default=1.0, above=0, at_most=1)
    detector_radius: float | None = number(
        "Radius of the circular field of view. Ions outside it are left out. By default the largest distance of an "
        "ion from the centre.",
        default=None,
        above=0,
        unit="mm",
    )
    area: float | None = number(
        "Area of the detector in place of `detector_radius`, for a detector that is not circular. No ion is left out.",
        default=None,
        above=0,
        unit="mm^2",
    )
    protocol: str = checked(
        'Depth increment: "cap", exact for a spherical cap, or "bas", with the area of the detector.',
        '{"cap", "bas"}',
        _protocol,
        default="cap",
    )
    radius: str | float | ArrayLike = checked(
        'Radius of the cap: "voltage", from the voltage of each ion; "shank", from the volume and the angle of the '
        "shank; or radii, a number or one for each of the hits.",
        "str, float or array_like",
        _radius,
        default="voltage",
        unit="nm",
    )
    initial_radius: float | None = number(
        'Radius of the cap at the first ion, for ``radius="shank"``.', default=None, above=0, unit="nm"
    )
    shank_angle: float | None = number(
        'Half the opening angle of the shank, for ``radius="shank"``.',
        default=None,
        at_least=0,
        below=45,
        unit="degrees",
    )
    smoothing: int = count("Number of ions, up to each ion, over which the voltage is averaged.", default=1, at_least=1)
    lens: LocalElectrode | None = part(
        "The lens of specimen and electrode in place of projection, field factor and compression, which then follow "
        "from the radius of each ion. For radii from the voltage, or radii of the user.",
        LocalElectrode,
        default=None,
    )

    def _check(self):
        if self.lens is not None:
            for name in ("projection", "field_factor", "compression"):
                if (value := getattr(self, name)) is not None:
                    raise ValueError(f"{name} follows from the lens, got {name}={short_text(value)} and a lens")
            if self.mode == "shank":
                raise ValueError('radius must be "voltage" or radii with a lens, got "shank"')
        if self.atomic_volume is None and self.element is None:
            raise ValueError("atomic_volume [nm^3] or element must be given, got None for both")
        if self.detector_radius is not None and self.area is not None:
            raise ValueError(
                f"detector_radius and area exclude each other, got {self.detector_radius} mm and {self.area} mm^2"
            )
        for mode, names in _NEEDS.items():
            for name in names:
                value = getattr(self, name)
                if mode != self.mode and value is not None:
                    raise ValueError(
                        f'{name} is for radius="{mode}", got {name}={short_text(value)} and {self.mode} radii'
                    )
                is_known = value is not None or (name == "evaporation_field" and self.element is not None)
                if mode == self.mode and not is_known:
                    raise ValueError(f'radius="{mode}" needs {" and ".join(names)}, got {name}=None')

    def __eq__(self, other: object) -> bool:
        if not isinstance(other, ReconstructionSettings):
            return NotImplemented
        return bool(to_plain(self) == to_plain(other))

    @property
    def mode(self) -> str:
        """Where the radius of the cap comes from: "voltage", "shank" or "given"."""
        return self.radius if isinstance(self.radius, str) else "given"

    def resolved(self) -> ReconstructionSettings:
        """These settings with a number for every constant that has a default.

        Returns
        -------
        ReconstructionSettings
            With a lens, compression, projection and field factor stay None.
        """
        values: dict[str, Any] = {}
        if isinstance(self.element, Material):
            values["atomic_volume"] = 1 / atom_density(self.element.structure, self.element.a, self.element.c)
            if self.mode == "voltage":
                values["evaporation_field"] = self.element.evaporation_field
        if self.lens is None:
            values |= {"projection": "bas", "compression": _COMPRESSION}
            if self.mode == "voltage":
                values["field_factor"] = _FIELD_FACTOR
        return replace(self, **{name: value for name, value in values.items() if getattr(self, name) is None})


def resolved_settings(settings: ReconstructionSettings | None, constants: Mapping[str, Any]) -> ReconstructionSettings:
    """Complete settings of a function that takes them as an object, as keywords that replace its fields, or both."""
    if settings is None:
        return from_plain(constants, ReconstructionSettings, what="settings of a reconstruction").resolved()
    check_kind(settings, "settings", ReconstructionSettings, "ReconstructionSettings")
    return changed(settings, constants).resolved()


def slope_of_shank(angle: float) -> float:
    """Increase of the radius per depth of the apex, dR/dz, on a shank with half this opening angle [degrees]."""
    sine = math.sin(math.radians(angle))
    return sine / (1 - sine)
