"""Mechanisms of emission and their parameters, as controls of the explorer. All controls follow from these tables."""

import math
from collections.abc import Mapping
from dataclasses import dataclass, fields
from typing import Any

from apt_evap._common.validation import check_choice, short_text
from apt_evap.emission.energies import TruncatedNormal
from apt_evap.emission.perturbations import Combined, LateralVelocity, Perturbation, RollUp, Unperturbed

MECHANISMS = {"unperturbed": Unperturbed, "lateral": LateralVelocity, "roll-up": RollUp, "combined": Combined}
"""Perturbation of each mechanism; the last three names are those of `fit_energies`."""


@dataclass(frozen=True)
class Control:
    """Slider for one number of a perturbation."""

    name: str
    title: str
    low: float
    high: float
    step: float
    value: float


CONTROLS = (
    # the grid of Shaikh et al. (2025) ends at 0.3725 eV; for the README's tip in real units that is 0.87 eV
    Control("mean", "mean energy [eV]", 0.0, 1.0, 0.005, 0.155),
    Control("relative_spread", "standard deviation / mean", 0.0, 3.2, 0.05, 1.0),
    Control("rollup_fraction", "roll-up fraction of the energy", 0.0, 1.0, 0.05, 0.5),
    Control("probability", "probability of a roll-up", 0.0, 1.0, 0.05, 1.0),
    Control("sharpness", "sharpness of the target", 0.0, 3.0, 0.05, 0.0),
    Control("height", "launch height [nm]", 0.0, 0.2, 0.005, 0.0),
    Control("others", "mean energy without roll-up [eV]", 0.0, 1.0, 0.005, 0.0),
)
"""Sliders for the emission. A mechanism has those that are fields of its perturbation; an energy has two."""

ENERGY = ("mean", "relative_spread")
"""Controls of an energy: mean [eV], and standard deviation relative to it, both before the truncation."""

_OTHERS = "others"  # their standard deviation is that of the other energy, relative to the mean

_DIGITS = 9  # of a standard deviation: removes the rounding of the product, far below any step


def controls_of(mechanism: str) -> tuple[Control, ...]:
    """Controls of a mechanism."""
    kind: Any = MECHANISMS[check_choice(mechanism, "mechanism", MECHANISMS)]
    names = {field.name for field in fields(kind)}
    if mechanism == "combined":
        names.discard(_OTHERS)  # they have the random part of the energy
    return tuple(
        control for control in CONTROLS if control.name in names or (control.name in ENERGY and "energy" in names)
    )


def perturbation_of(mechanism: str, values: Mapping[str, float]) -> Perturbation:
    """Perturbation of a mechanism for the values of its controls."""
    names = [control.name for control in controls_of(mechanism)]
    for name in names:
        if name not in values:
            raise ValueError(f"values must contain {name!r} for the mechanism {mechanism!r}, got {short_text(values)}")
    options: dict[str, Any] = {name: values[name] for name in names if name not in (*ENERGY, _OTHERS)}
    if ENERGY[0] in names:
        options["energy"] = _distribution(*(values[name] for name in ENERGY))
    if _OTHERS in names and values[_OTHERS] > 0:
        options[_OTHERS] = _distribution(values[_OTHERS], values[ENERGY[1]])
    kind: Any = MECHANISMS[mechanism]
    return kind(**options)


def _distribution(mean, relative_spread):
    return TruncatedNormal(mean, round(relative_spread * mean, _DIGITS)) if relative_spread * mean > 0 else mean


def values_of(perturbation: Perturbation) -> tuple[str, dict[str, float]]:
    """Mechanism of a perturbation, and the values of its controls."""
    kinds = {kind: mechanism for mechanism, kind in MECHANISMS.items()}
    if type(perturbation) not in kinds:
        names = ", ".join(kind.__name__ for kind in kinds)
        raise ValueError(f"the explorer has controls for {names}, got {short_text(perturbation)}")
    mechanism = kinds[type(perturbation)]
    values = {}
    for control in controls_of(mechanism):
        if control.name in ENERGY:
            energy: Any = getattr(perturbation, "energy")  # noqa: B009  # a perturbation need not have one
            values |= dict(zip(ENERGY, _mean_and_relative_spread(energy), strict=True))
        elif control.name == _OTHERS:
            values[_OTHERS] = _of_others(getattr(perturbation, _OTHERS), values)
        else:
            value = getattr(perturbation, control.name)
            if not isinstance(value, float):
                raise ValueError(f"the explorer has controls for a number as {control.name}, got {short_text(value)}")
            values[control.name] = value
    kind: Any = type(perturbation)
    for option in fields(kind):
        value = getattr(perturbation, option.name)
        if option.name != "energy" and option.name not in values and value != option.default:
            raise ValueError(f"the explorer has controls for all options but {option.name}, got {short_text(value)}")
    return mechanism, values


def _mean_and_relative_spread(energy):
    if isinstance(energy, float):
        return energy, 0.0
    if isinstance(energy, TruncatedNormal) and energy.mean > 0:
        return energy.mean, energy.standard_deviation / energy.mean
    raise ValueError(
        "the explorer has controls for a number [eV] or a TruncatedNormal of mean > 0 as energy, "
        f"got {short_text(energy)}"
    )


def _of_others(energy, values):
    """Mean energy of the ions that do not roll up."""
    if energy is None:
        return 0.0
    mean, relative_spread = _mean_and_relative_spread(energy)
    if mean == 0.0 or not math.isclose(relative_spread, values["relative_spread"], rel_tol=1e-6, abs_tol=1e-6):
        raise ValueError(
            "the explorer has controls for others with a mean > 0 and the relative standard deviation of the energy, "
            f"{values['relative_spread']:.3g}, got {short_text(energy)}"
        )
    return mean
