"""How sure the positions of an evolving reconstruction are."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import scipy
from numpy.typing import ArrayLike

from apt_evap._common.types import Floats
from apt_evap._common.validation import check_array, check_choice, check_kind, check_number, short_text
from apt_evap.reconstruction.evolving import EvolvingReconstruction
from apt_evap.reconstruction.evolving_surface import IonSequence
from apt_evap.reconstruction.twin_correction import without_means

CONSTANT_ERRORS: Mapping[str, float] = {"compression": 0.05, "radius": 0.05, "efficiency": 0.05}
"""Relative standard errors of the constants where none are given."""
LOCAL_SCATTER = (0.174, 0.057)
"""Scatter of ions along the surface, in each of two directions, and across it [nm]: aluminium, 12 nm, ions at rest."""
ROLLED_SCATTER = (0.749, 0.078)
"""The same of aluminium that rolls, `RollUp.of_metal`: intervals hold 0.66 / 0.65 / 0.97 / 0.95 in the half of the view
that it was not measured in, 0.19 / 0.36 / 0.38 / 0.64 with the scatter at rest."""

_BLOCKS = 50  # of the sequence
_CLOSE, _NEAR = 4, 24  # neighbours over which corrections of halves, and their squares, are averaged


def position_covariances(
    reconstruction: EvolvingReconstruction,
    constant_errors: Mapping[str, float] | ArrayLike | None = None,
    local: Sequence[float] | None = None,
) -> Floats:
    """Covariance of the position of each ion.

    Parameters
    ----------
    reconstruction : EvolvingReconstruction
        A reconstruction whose surface was followed.
    constant_errors : mapping or array_like, optional
        Relative standard errors of "compression", "radius" and "efficiency"; 0.05 for those that are left out. Or their
        relative covariances in this order, shape (3, 3), such as `CrystalConstants.covariance`.
    local : sequence of float, optional
        Scatter of the ions about their neighbours along the surface and across it [nm], such as `local_scatter` of a
        simulated specimen of the same matrix. By default what the mean errors of the twin leave, with half of them
        in doubt, if the reconstruction was corrected by one, else `LOCAL_SCATTER`. Hits do not tell whether their ions
        rolled: if they did, give `ROLLED_SCATTER`.

    Returns
    -------
    ndarray, shape (n, 3, 3)
        Of x, y and depth [nm^2], after a common shift.

    Raises
    ------
    ValueError
        If the cap was used, or an error is out of range.

    Notes
    -----
    The sum of four parts: half the difference of two reconstructions, each from half of the ions, smoothed over 24
    neighbours; the change by one standard error of each constant, or of each of their independent combinations; what
    the recession is not sure about, see `EvolvingReconstruction.recession_changes`, averaged over 24 ions of about the
    same direction at any time if no phase is at the rim; and the local scatter, which comes from the emission and the
    lattice and is not seen in any measurement. An ion whose place on the surface is wrong is moved along it: far from
    the axis this changes its depth, too.
    """
    check_kind(reconstruction, "reconstruction", EvolvingReconstruction, "an EvolvingReconstruction")
    constants, ions = constant_changes(constant_errors), reconstruction.sequence
    usual = reconstruction.again(ions)
    sphere = ions.radius * ions.directions - np.array([0, 0, 1]) * ions.depths[1:, None]
    if local is None:
        twin = reconstruction.twin_errors
        local = LOCAL_SCATTER if twin is None else twin.scatter(float(np.median(reconstruction.radii)))
    total = local_covariances(ions, local)
    corrections = []
    for first in (0, 1):
        rows = slice(first, None, 2)
        # all ions of a half on the sphere, and by how much the surface moves them
        moved = reconstruction.again(ions.part(first, 2), rows) - sphere[rows]
        near = scipy.spatial.cKDTree(sphere[rows]).query(sphere, k=_CLOSE)[1]
        corrections.append(moved[near].mean(axis=1))
    half = (corrections[0] - corrections[1]) / 2
    half -= half.mean(axis=0)
    total += _mean_products(half, sphere)
    changes = [reconstruction.again(changed_sequence(reconstruction, change)) - usual for change in constants]
    if reconstruction.followed_by != "surface":  # a draw: where two measures agree by chance neither is sure
        for change in reconstruction.recession_changes():
            total += _mean_products(change - change.mean(axis=0), ions.directions)
    else:
        changes += reconstruction.recession_changes()
    for change in changes:
        change -= change.mean(axis=0)
        total += change[:, :, None] * change[:, None, :]
    total *= np.array([1, 1, -1])[:, None] * np.array([1, 1, -1])  # depth in place of z
    if len(usual) == len(reconstruction):
        return total
    places = reconstruction.positions
    stride = -(-len(places) // len(usual))
    return np.asarray(total[scipy.spatial.cKDTree(places[::stride]).query(places)[1]])


def _mean_products(changes, places):
    """Products of the components of changes, shape (n, 3, 3), means over ions at neighbouring places."""
    near = scipy.spatial.cKDTree(places).query(places, k=_NEAR)[1]
    return (changes[:, :, None] * changes[:, None, :])[near].mean(axis=1)


def local_covariances(ions: IonSequence, local: Sequence[float]) -> Floats:
    """Covariance of the scatter along the surface, a sphere, and across it [nm^2], shape (n, 3, 3)."""
    along, across = (check_number(value, "local", at_least=0, unit="nm") for value in check_array(local, "local", (2,)))
    normals = ions.directions
    found: Floats = along**2 * np.eye(3) + (across**2 - along**2) * normals[:, :, None] * normals[:, None, :]
    return found


def local_scatter(reconstruction: EvolvingReconstruction, sites: ArrayLike) -> tuple[float, float]:
    """Scatter of the errors of ions about the mean error of those that left at about the same time.

    Parameters
    ----------
    reconstruction : EvolvingReconstruction
        Reconstruction of a simulated specimen, such as the pure matrix of a measured one.
    sites : array_like
        True sites of its ions [nm], shape (n, 3), with z out of the specimen.

    Returns
    -------
    tuple of float
        Standard deviation along the surface, in each of two directions, and across it [nm], for `position_covariances`.
    """
    check_kind(reconstruction, "reconstruction", EvolvingReconstruction, "an EvolvingReconstruction")
    true = check_array(sites, "sites", (len(reconstruction), 3))
    errors = reconstruction.specimen_positions - true
    # the mean of a block is an error of the recession, which the constants and the halves account for
    left = without_means(errors, _BLOCKS)
    places, angles = reconstruction.geometry.places(reconstruction.hits, reconstruction.radii)
    across = np.einsum("ni,ni->n", left, np.column_stack([places, np.cos(angles)]))
    along = ((left**2).sum(axis=1) - across**2) / 2
    return math.sqrt(max(float(along.mean()), 0.0)), float(np.sqrt((across**2).mean()))


def constant_changes(given: Mapping[str, float] | ArrayLike | None) -> list[Any]:
    """Relative changes of compression, radius and efficiency that are independent, by one standard error each."""
    if given is None or isinstance(given, Mapping):
        errors = dict(CONSTANT_ERRORS)
        for name, value in (given or {}).items():
            check_choice(name, "constant_errors", tuple(CONSTANT_ERRORS))
            errors[name] = check_number(value, f"constant_errors[{name!r}]", at_least=0, below=0.5)
        changes = np.diag(list(errors.values()))
    else:
        covariance = check_array(given, "constant_errors", (3, 3))
        variances, directions = np.linalg.eigh(covariance)
        if np.abs(covariance - covariance.T).max() > 1e-9 or variances[0] < -1e-9 or variances[-1] >= 0.25:
            raise ValueError(f"constant_errors must be covariances below 0.25, got {short_text(covariance.tolist())}")
        directions *= np.sign(directions[np.abs(directions).argmax(axis=0), range(3)])  # one of two signs
        changes = np.sqrt(np.maximum(variances, 0))[:, None] * directions.T
    return [change for change in changes if np.abs(change).max() > 1e-6]


def changed_sequence(reconstruction: EvolvingReconstruction, changes: Sequence[float]) -> IonSequence:
    """The ions with relative changes of compression, radius and efficiency."""
    compression, radius, efficiency = (1 + change for change in changes)
    ions = reconstruction.sequence
    ions = replace(ions, radius=ions.radius * radius, volume=ions.volume / efficiency)
    if compression == 1:
        return ions
    every = -(-len(reconstruction) // len(ions.directions))
    hits, radii = reconstruction.hits[::every], reconstruction.radii[::every]
    geometry = replace(reconstruction.geometry, compression=reconstruction.geometry.compression * compression)
    places, angles = geometry.places(hits, radii)
    rim = float(np.mean(geometry.rim_angles(hits, radii)))
    return replace(ions, directions=np.column_stack([places, np.cos(angles)]), rim=rim)
