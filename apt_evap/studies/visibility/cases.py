"""A specimen with a feature, for other sizes, fields, depths and radii of the apex, and its full simulation."""

from collections.abc import Iterable, Mapping
from dataclasses import replace
from typing import Any

import numpy as np

from apt_evap._common.codec import to_plain
from apt_evap._common.types import Floats
from apt_evap._common.validation import check_choice, check_kind, check_number
from apt_evap.emission.perturbations import Perturbation, Unperturbed
from apt_evap.simulation.run import Run
from apt_evap.simulation.simulation import Simulation
from apt_evap.specimen.lattice import atom_density
from apt_evap.specimen.phases import Phase
from apt_evap.specimen.regions import Layer, Sphere
from apt_evap.specimen.tip import Tip

VARIABLES = {
    "size": "radius of a sphere or thickness of a layer [nm]",
    "field_ratio": "evaporation field of the feature over that of the matrix",
    "cover": "depth of its uppermost point below the apex [nm]",
    "apex_radius": "radius of the apex [nm]",
}
"""What can be varied in a specimen with a feature."""

_MOST = 0.9  # fraction of the atoms of a very small tip that can evaporate
_BELOW = 1.2  # nm that evaporate below the feature, so that its last atoms do


def specimen_of(tip: Tip) -> dict[str, Any]:
    """Arguments of `Tip` that make this specimen again, without its seeds."""
    check_kind(tip, "specimen", Tip, "a Tip")
    if not tip.phases:
        raise ValueError("specimen must be a Tip of a crystal, got one from positions")
    names = ("apex_radius", "axis", "shank_angle", "shank_length", "base", "rotation", "origin")
    return {name: tip.settings[name] for name in names} | {"phases": tip.phases}


def is_across(layer: Layer) -> bool:
    """Whether a layer lies across the axis, rather than along it."""
    return abs(layer.normal[2]) > 0.7 * float(np.linalg.norm(layer.normal))


def size_of(feature: Phase) -> float:
    """Radius or thickness [nm]; NaN for other regions."""
    match feature.region:
        case Sphere(radius=radius):
            return radius
        case Layer(lower=lower, upper=upper):
            return upper - lower
    return float("nan")


def check_feature(feature: Phase) -> Phase:
    """A feature: a phase, perhaps with a region."""
    return check_kind(feature, "feature", Phase, "a Phase such as Phase('particle', 'Al', Sphere((0, 0, 7), 1))")


def varied(feature: Phase, specimen: Mapping[str, Any], **values: float) -> tuple[Phase, dict[str, Any]]:
    """Feature and arguments of `Tip` with other values of `VARIABLES`.

    The depth of the uppermost point of a sphere or of a layer across the axis stays, and the middle of other layers.
    """
    for name in values:
        check_choice(name, "name of a variable", VARIABLES)
    radius = check_number(values.get("apex_radius", specimen["apex_radius"]), "apex_radius", above=0, unit="nm")
    arguments = {**specimen, "apex_radius": radius}
    if "apex_radius" in values:
        arguments["shank_length"] = specimen["shank_length"] * radius / specimen["apex_radius"]
    region, size = feature.region, values.get("size", size_of(feature))
    if not np.isfinite(size) and "size" in values:
        raise ValueError("size can be varied for a Sphere or a Layer only")
    if isinstance(region, Sphere):
        x, y, z = region.centre
        cover = values.get("cover", specimen["apex_radius"] - z - region.radius)
        region = Sphere((x, y, radius - cover - size), size)
    elif isinstance(region, Layer) and is_across(region):
        down = region.normal[2] < 0
        upper = -region.lower if down else region.upper
        upper = radius - values.get("cover", specimen["apex_radius"] - upper)
        lower, upper = (-upper, size - upper) if down else (upper - size, upper)
        region = Layer(lower, upper, region.normal)
    elif isinstance(region, Layer):
        middle = (region.lower + region.upper) / 2
        region = Layer(middle - size / 2, middle + size / 2, region.normal)
    if "field_ratio" in values:
        field = values["field_ratio"] * specimen["phases"][0].material.evaporation_field
        feature = replace(feature, evaporation_field=field)
    return replace(feature, region=region), arguments


def values_of(feature: Phase, specimen: Mapping[str, Any], names: Iterable[str]) -> dict[str, float]:
    """Values of `VARIABLES` that a feature and a specimen have, of some names; those of another region are left out."""
    host = specimen["phases"][0].material
    field = feature.material.evaporation_field if feature.evaporation_field is None else feature.evaporation_field
    radius, size, region = specimen["apex_radius"], size_of(feature), feature.region
    known = {"apex_radius": radius, "field_ratio": field / host.evaporation_field}
    if np.isfinite(size):
        known["size"] = size
    if isinstance(region, Sphere):
        known["cover"] = radius - region.centre[2] - region.radius
    elif isinstance(region, Layer) and is_across(region):
        known["cover"] = radius - (region.upper if region.normal[2] > 0 else -region.lower)
    return {name: known[name] for name in names if name in known}


def bottom_of(feature: Phase, radius: float) -> float:
    """Depth of the lowest point of a feature below the apex [nm]; of what reaches further, 3 nm."""
    match feature.region:
        case Sphere(centre=centre, radius=size):
            return radius - centre[2] + size
        case Layer() as layer if is_across(layer):
            return radius - (layer.lower if layer.normal[2] > 0 else -layer.upper)
    return 3.0


def made(feature: Phase | None, arguments: Mapping[str, Any], seed: int, depth: float) -> Tip:
    """Tip with a feature, whose lattice is shifted at random."""
    phases = arguments["phases"] if feature is None else (*arguments["phases"], feature)
    # the shell reaches below what evaporates by its support and the curvature of the cap
    shell = min(depth + 3.0, 0.9 * arguments["apex_radius"])
    return Tip(**{**arguments, "phases": phases}, depth=shell, seed=seed, offset_seed=seed)


def simulated(
    feature: Phase,
    arguments: Mapping[str, Any],
    perturbation: Perturbation | None = None,
    *,
    seed: int = 1,
    depth: float | None = None,
    n_threads: int | None = None,
    **settings: Any,
) -> Run:
    """Run of a specimen with a feature, until the apex is 1.2 nm below it, or at a depth [nm]."""
    radius = arguments["apex_radius"]
    depth = bottom_of(feature, radius) + _BELOW if depth is None else depth
    tip = made(feature, arguments, seed, depth)
    host = arguments["phases"][0].material
    ions = round(depth * np.pi * radius**2 * atom_density(host.structure, host.a, host.c))
    ions = min(ions, int(_MOST * np.count_nonzero(tip.evaporable)))
    simulation = Simulation(tip, seed=seed, n_threads=n_threads, **settings)
    # energies are those at the evaporation field: flights with perturbations need the responses of the run
    rest = perturbation is None or perturbation == Unperturbed()
    run = simulation.run(ions, [Unperturbed()] if rest else [], responses=not rest, progress=False)
    return run.unless_interrupted()


def depth_for(feature: Phase, specimen: Mapping[str, Any], nodes: list[dict[str, float]]) -> float:
    """Depth that evaporates [nm] so that the lowest of several variants of a feature is behind the apex."""
    variants = (varied(feature, specimen, **values) for values in nodes)
    return max(bottom_of(variant, arguments["apex_radius"]) for variant, arguments in variants) + _BELOW


def coordinates(feature: Phase, sites: Floats, radius: float) -> tuple[Floats, Floats]:
    """Two coordinates of each site about a feature, shape (n, 2), and the directions of its shifts, shape (n, 3, 3).

    The coordinates of a sphere are the distance from the line through its centre along the axis, and the height above
    it, over its radius. Those of a layer are the distance from its middle over half its thickness, and the distance
    from the axis within it over the radius of the apex. The directions are away from the axis of the feature (for a
    layer along the axis, its normal), across, and along the axis of the specimen.
    """
    x, y, z = sites.T
    region = feature.region
    away = np.column_stack([x, y])
    if isinstance(region, Sphere):
        away = away - region.centre[:2]
        places = np.column_stack([(z - region.centre[2]) / region.radius, np.linalg.norm(away, axis=1) / region.radius])
    elif isinstance(region, Layer):
        normal = np.array(region.normal) / np.linalg.norm(region.normal)
        distance = (sites @ normal - (region.lower + region.upper) / 2) / ((region.upper - region.lower) / 2)
        if is_across(region):
            places = np.column_stack([distance, np.linalg.norm(away, axis=1) / radius])
        else:
            away = np.broadcast_to(normal[:2], away.shape)
            places = np.column_stack([distance, np.abs(x * normal[1] - y * normal[0]) / radius])
    else:  # the whole specimen: depth below the apex, distance from the axis
        places = np.column_stack([(z - radius) / radius, np.linalg.norm(away, axis=1) / radius])
    length = np.linalg.norm(away, axis=1)
    along = np.divide(away, length[:, None], out=np.tile([1.0, 0.0], (len(z), 1)), where=length[:, None] > 0)
    directions = np.zeros((len(z), 3, 3))
    directions[:, 0, :2], directions[:, 2, 2] = along, 1.0
    directions[:, 1, 0], directions[:, 1, 1] = -along[:, 1], along[:, 0]
    return places, directions


def described(feature: Phase, specimen: Mapping[str, Any]) -> dict[str, Any]:
    """Feature and specimen in plain types."""
    return {"feature": to_plain(feature), "specimen": to_plain(specimen)}
