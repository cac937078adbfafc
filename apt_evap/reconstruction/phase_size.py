"""The size of a phase that a reconstruction has found, with an error."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from apt_evap._common.types import Booleans, Floats
from apt_evap._common.validation import check_kind
from apt_evap.reconstruction.evolving import EvolvingReconstruction
from apt_evap.reconstruction.position_errors import (
    LOCAL_SCATTER,
    changed_sequence,
    constant_changes,
    local_covariances,
)

BURST_WIDTH = 0.1
"""Part of the width of phases that leave in bursts that is in doubt: they are 1.07 to 1.14 times as wide."""

_FEWEST = 50  # ions of a phase
_FAR = 1.6  # times the ellipsoid: ions farther out are strays
_TURNS = 5


class PhaseSize(NamedTuple):
    """Semi-axes of the ellipsoid with the second moments of a phase."""

    name: str
    """Name of the phase."""
    ions: int
    """Ions of it."""
    lateral: float
    """Semi-axis across the axis of the specimen, mean of both directions [nm]."""
    depth: float
    """Semi-axis along the axis [nm]."""
    lateral_error: float
    """Standard error of the lateral semi-axis [nm]."""
    depth_error: float
    """Standard error of the semi-axis along the axis [nm]."""
    correlation: float
    """Of both errors."""

    def __str__(self) -> str:
        return (
            f"{self.name}: semi-axes {self.lateral:.2f} ± {self.lateral_error:.2f} nm across and {self.depth:.2f} ± "
            f"{self.depth_error:.2f} nm along the axis, correlation {self.correlation:.2f}, of {self.ions:,} ions"
        )


def phase_sizes(
    reconstruction: EvolvingReconstruction,
    constant_errors: Mapping[str, float] | ArrayLike | None = None,
    local: Sequence[float] = LOCAL_SCATTER,
) -> list[PhaseSize]:
    r"""Sizes of the phases that an evolving surface has found.

    Parameters
    ----------
    reconstruction : EvolvingReconstruction
        A reconstruction whose surface was followed.
    constant_errors : mapping or array_like, optional
        As for `position_covariances`.
    local : sequence of float
        Scatter of the ions along the surface and across it [nm], as for `position_covariances`; it widens a phase.

    Returns
    -------
    list of PhaseSize

    Raises
    ------
    ValueError
        If the cap was used, or an error is out of range.

    Notes
    -----
    A uniform ellipsoid has semi-axes of :math:`\sqrt 5` times its standard deviations. Those of the local scatter are
    taken off. The errors are the changes by one standard error of each constant, and those of
    `EvolvingReconstruction.recession_changes`, which act on all ions together, and the counts; half of what was taken
    off is added. Of phases that leave in bursts a tenth of the lateral semi-axis is added. Phases of fewer than 50 ions
    are left out.

    A phase that goes on beyond the field of view has the size of what is seen of it.
    """
    check_kind(reconstruction, "reconstruction", EvolvingReconstruction, "an EvolvingReconstruction")
    constants = constant_changes(constant_errors)
    if reconstruction.history is None:
        raise ValueError(f"reconstruction must have a surface that was followed, got {reconstruction.verdict!r}")
    usual = reconstruction.again(reconstruction.sequence)
    blurred = np.einsum("nii->ni", local_covariances(reconstruction.sequence, local))
    moved = [reconstruction.again(changed_sequence(reconstruction, change)) for change in constants]
    moved += [usual + change for change in reconstruction.recession_changes()]
    found = []
    for one, feature in reconstruction.found_features:
        near = _near(usual, feature.members)
        # its own ions less those of the matrix: what is near by its composition alone has noise, and is larger
        background = float(feature.own[~near].mean()) if not near.all() else feature.background
        weights = feature.own[near] - background
        if np.count_nonzero(feature.own & near) < _FEWEST or weights.sum() <= 0:
            continue
        scatter = np.array([blurred[near, :2].mean(), blurred[near, 2].mean()])
        axes = _semi_axes(usual[near], weights, scatter)
        changes = np.array([_semi_axes(part[near], weights, scatter) - axes for part in moved]).reshape(-1, 2)
        blur = (_semi_axes(usual[near], weights, 0 * scatter) - axes) / 2
        counts = axes * math.sqrt(float((weights**2).sum())) / float(weights.sum()) / math.sqrt(2)
        covariance = changes.T @ changes + np.diag(blur**2 + counts**2)
        if reconstruction.followed_by == "volume":  # although there are phases: they leave in bursts
            covariance[0, 0] += (BURST_WIDTH * axes[0]) ** 2
        (lateral, depth), (across, along) = axes.tolist(), np.sqrt(np.diag(covariance)).tolist()
        correlation = float(covariance[0, 1]) / (across * along)
        found.append(PhaseSize(one.name, one.ions, lateral, depth, across, along, correlation))
    return found


def _near(positions: Floats, members: Booleans) -> Booleans:
    """Ions within 1.6 times the ellipsoid of the second moments of the members, which are found without strays."""
    near = inside = members
    for _ in range(_TURNS):
        cloud = positions[inside]
        if len(cloud) < _FEWEST:
            break
        away = positions - np.median(cloud, axis=0)
        near = np.einsum("ni,ij,nj->n", away, np.linalg.pinv(np.cov(cloud.T)), away) <= 5 * _FAR**2
        inside = members & near
    return near


def _semi_axes(cloud, weights, scatter):
    """Semi-axes across and along the axis without the variances of the local scatter [nm], shape (2,)."""
    shares = weights / weights.sum()
    variances = np.maximum(shares @ (cloud - shares @ cloud) ** 2, 0.0)
    both = np.array([variances[:2].mean(), variances[2]])
    return np.sqrt(5 * np.maximum(both - scatter, 0.1 * both))
