"""The angle of the shank from the history of the voltage."""

from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
import scipy

from apt_evap._common.types import Floats
from apt_evap._common.validation import check_kind
from apt_evap.detection.hits import Hits
from apt_evap.detection.microscope.local_electrode import LocalElectrode
from apt_evap.reconstruction.reconstruct import reconstruct
from apt_evap.reconstruction.reconstructed import Reconstruction
from apt_evap.reconstruction.reconstruction_settings import (
    ReconstructionSettings,
    resolved_settings,
    slope_of_shank,
)

_ANGLES = (0.5, 1.0, 2.0, 3.0, 5.0, 7.0, 10.0, 14.0, 20.0)  # degrees, between which the angle is searched
_IONS = 20_000  # that are reconstructed: the radius is a mean over many ions
_SECTIONS = 40  # of the sequence, for the slope and its error
_PRECISION = 1e-2  # degrees
_STEP = 0.01  # relative, for the sensitivities


class ShankFit(NamedTuple):
    """Angle of the shank that agrees with the voltages of a measurement; made by `fit_shank`."""

    angle: float
    """Half the opening angle [degrees]."""
    error: float
    """Standard error from the scatter of the radii about a straight shank [degrees]."""
    depths: Floats
    """Depth of the apex in each section of the sequence [nm], shape (k,)."""
    radii: Floats
    """Radius of the apex in each section [nm], shape (k,)."""
    per_cent: dict[str, float]
    """Change of the angle [degrees] if a constant is 1 % larger, by its name: the voltages fix one combination only."""

    def __repr__(self) -> str:
        changes = ", ".join(f"{change:+.2g} for 1 % more {name}" for name, change in self.per_cent.items())
        radii = f"R {self.radii[0]:.3g} to {self.radii[-1]:.3g} nm in {np.ptp(self.depths):.3g} nm"
        return f"<ShankFit: {self.angle:.2f} +- {self.error:.2f} degrees, {radii}; {changes}>"


def fit_shank(
    hits: Hits, lens: LocalElectrode, settings: ReconstructionSettings | None = None, **constants: Any
) -> ShankFit:
    r"""Fit the angle of the shank to the history of the voltage.

    Parameters
    ----------
    hits : Hits
        Ions with voltages, in the sequence of evaporation.
    lens : LocalElectrode
        Lens with the geometry of the microscope; the angle of its shank is replaced. Not with a profile.
    settings, **constants
        As for `reconstruct`: element, distance, efficiency, detector_radius, ...

    Returns
    -------
    ShankFit
        Use it as ``dataclasses.replace(lens, shank_angle=fit.angle)``.

    Raises
    ------
    ValueError
        If no angle from 0.5 to 20 degrees agrees with the voltages, for example because they do not rise, or the lens
        has a profile.

    Notes
    -----
    With the angle :math:`\alpha`, the lens gives the radius of each ion from its voltage, and the volume of the ions
    the depth of the apex. On a shank with this angle

    .. math:: \frac{dR}{dz} = \frac{\sin\alpha}{1 - \sin\alpha} ,

    and the angle is the one for which this holds. A voltage curve alone determines one number. Another evaporation
    field, efficiency or field of view would change the angle by `ShankFit.per_cent`.

    Examples
    --------
    >>> lens = ae.detection.LocalElectrode(40e3, 20e3, shank_angle=6.0)
    >>> radii = np.linspace(30.0, 40.0, 2000)  # nm, of a cap that recedes on this shank
    >>> rng = np.random.default_rng(1)
    >>> places = rng.uniform(-20, 20, (2, 2000))
    >>> ions = ae.Hits(x=places[0], y=places[1], voltage=lens.field_factor(radii) * 35.0 * radii)
    >>> known = {"atomic_volume": 19.3, "distance": 90.0, "detector_radius": 20.0, "evaporation_field": 35.0}
    >>> round(ae.reconstruction.fit_shank(ions, lens, **known).angle, 1)
    6.0
    """
    check_kind(hits, "hits", Hits, "Hits, such as read(path)")
    check_kind(lens, "lens", LocalElectrode, "a LocalElectrode")
    if lens.profile is not None:
        raise ValueError("lens has a profile, which gives the angle of the shank at every radius")
    hits = hits[hits.detected]
    stride = max(1, -(-len(hits) // _IONS))
    known = resolved_settings(settings, {**constants, "lens": lens})
    if known.mode != "voltage":
        raise ValueError(f'radius must be "voltage" for a fit to the voltages, got {known.mode} radii')
    thinned, known = hits[::stride], replace(known, efficiency=known.efficiency / stride)

    def sections(angle, changed):
        lens = replace(changed.lens, shank_angle=angle)
        return _sections(reconstruct(thinned, replace(changed, lens=lens)))

    def excess(angle, changed=known):
        """Slope of the radii over the depths beyond that of a shank with this angle."""
        return _slope(*sections(angle, changed))[0] - slope_of_shank(angle)

    # upwards, because the lens of a blunt shank shows less than the detector sees
    values = []
    for angle in _ANGLES:
        values.append(excess(angle))
        if not values[-1] > 0:
            break
    if len(values) == 1 or values[-1] > 0:
        raise ValueError(
            f"hits must have voltages that agree with a shank of {_ANGLES[0]:g} to {_ANGLES[-1]:g} degrees, got radii "
            f"that change by {values[0] + slope_of_shank(_ANGLES[0]):.3g} nm per nm of depth"
        )
    angle = float(scipy.optimize.brentq(excess, *_ANGLES[len(values) - 2 : len(values)], xtol=_PRECISION))
    depths, radii = sections(angle, known)
    # sensitivities: the change of the angle that makes up for a change of a constant
    slope = (excess(angle + 0.1) - excess(angle)) / 0.1
    farther = replace(lens, distance=lens.distance * (1 + _STEP))
    field, volume = known.evaporation_field, known.atomic_volume
    larger = {
        "evaporation field": replace(known, evaporation_field=field * (1 + _STEP)),  # type: ignore[operator]
        "volume per detected ion": replace(known, atomic_volume=volume * (1 + _STEP)),  # type: ignore[operator]
        "distance of the electrode": replace(known, lens=farther),
    }
    per_cent = {name: float(-excess(angle, changed) / slope) for name, changed in larger.items()}
    return ShankFit(angle, abs(_slope(depths, radii)[1] / slope), depths, radii, per_cent)


def _sections(reconstruction: Reconstruction) -> tuple[Floats, Floats]:
    """Mean depth of the apex and mean radius of successive ions, each of shape (k,)."""
    parts = np.array_split(np.arange(len(reconstruction)), min(_SECTIONS, len(reconstruction)))
    depths, radii = reconstruction.depths, reconstruction.radii
    return np.array([depths[part].mean() for part in parts]), np.array([radii[part].mean() for part in parts])


def _slope(depths, radii):
    """Slope of the radii over the depths, and its standard error from the scatter of the sections."""
    if len(depths) < 3 or np.ptp(depths) == 0:
        raise ValueError(f"hits must have at least 3 ions at different depths, got {len(depths)}")
    fit = scipy.stats.linregress(depths, radii)
    return float(fit.slope), float(fit.stderr)
