"""Shape and composition of a reconstructed precipitate against the truth."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from apt_evap._common.codec import for_json
from apt_evap._common.types import Booleans, Floats, Integers
from apt_evap._common.validation import check_kind, short_text
from apt_evap.reconstruction.errors import groups_of, per_ion, true_sites
from apt_evap.reconstruction.reconstructed import Reconstruction
from apt_evap.simulation.run import Run

_FEWEST = 10  # ions of a precipitate: three times the dimensions of its moments


@dataclass(frozen=True)
class SemiAxes:
    """Ellipsoid with the second moments of a cloud of ions.

    Parameters
    ----------
    lateral : float
        Semi-axis across the axis of the specimen, mean of both directions [nm].
    depth : float
        Semi-axis along the axis [nm].
    """

    lateral: float
    depth: float

    @property
    def ratio(self) -> float:
        """Lateral semi-axis over that in depth."""
        return self.lateral / self.depth

    @property
    def volume(self) -> float:
        """Volume of the ellipsoid [nm^3]."""
        return 4 / 3 * math.pi * self.lateral**2 * self.depth


@dataclass(frozen=True, eq=False)
class PrecipitateErrors:
    """What a reconstruction shows of a precipitate, beside the truth.

    Parameters
    ----------
    ions : int
        Ions of the precipitate.
    true, apparent : SemiAxes
        Semi-axes of the sites of these ions, and of their reconstructed positions.
    overlap : float
        Fraction of ions of the matrix among the ions within the apparent ellipsoid.
    lost : float
        Fraction of the ions of the precipitate outside the apparent ellipsoid.
    true_overlap, true_lost : float
        The same for the sites, whose ellipsoid differs from the precipitate if this is not an ellipsoid.
    species : ndarray of int, shape (k,)
        Species within the apparent ellipsoid or in the precipitate.
    true_composition, apparent_composition : ndarray, shape (k,)
        Fraction of each species among the ions of the precipitate, and among those within the apparent ellipsoid.
    composition_errors : ndarray, shape (k,)
        Standard deviation of the apparent fraction by the number of ions.
    """

    ions: int
    true: SemiAxes
    apparent: SemiAxes
    overlap: float
    lost: float
    true_overlap: float
    true_lost: float
    species: Integers = field(repr=False)
    true_composition: Floats = field(repr=False)
    apparent_composition: Floats = field(repr=False)
    composition_errors: Floats = field(repr=False)

    @property
    def magnification(self) -> float:
        """Local magnification: apparent over true lateral semi-axis; below 1 for a precipitate of a low field."""
        return self.apparent.lateral / self.true.lateral

    @property
    def depth_magnification(self) -> float:
        """Apparent over true semi-axis in depth."""
        return self.apparent.depth / self.true.depth

    @property
    def density_ratio(self) -> float:
        """Apparent over true number density of all ions within the ellipsoids."""
        kept = (1 - self.lost) / (1 - self.overlap)
        true = (1 - self.true_lost) / (1 - self.true_overlap)
        return kept / true * self.true.volume / self.apparent.volume

    def to_dict(self) -> dict[str, Any]:
        """All results as numbers and lists, for JSON.

        Returns
        -------
        dict
        """
        names = ("ions", "overlap", "lost", "magnification", "depth_magnification", "density_ratio")
        names += ("species", "true_composition", "apparent_composition", "composition_errors")
        axes = {
            name: {part: getattr(getattr(self, name), part) for part in ("lateral", "depth", "ratio")}
            for name in ("true", "apparent")
        }
        return for_json({name: getattr(self, name) for name in names} | axes)


def precipitate_errors(
    reconstruction: Reconstruction,
    inside: ArrayLike,
    truth: Run | ArrayLike | None = None,
    species: ArrayLike | None = None,
    fit: Sequence[str] = (),
) -> PrecipitateErrors:
    r"""Compare a reconstructed precipitate with the truth.

    Parameters
    ----------
    reconstruction : Reconstruction
        The reconstructed ions.
    inside : array_like of bool
        Whether each reconstructed ion belongs to the precipitate, shape (n,); or each ion of the run.
    truth : Run or array_like, optional
        As for `Reconstruction.errors`: run or sites of the ions [nm]; by default the positions of simulated hits.
    species : array_like of int, optional
        Species of each ion, shape (n,); by default that of the run or of an instrument. Without any, 0 for the matrix
        and 1 for the precipitate.
    fit : sequence of str
        Free constants that are fitted to all ions before, as for `Reconstruction.errors`. By default none: lengths are
        compared as they are reconstructed.

    Returns
    -------
    PrecipitateErrors

    Raises
    ------
    ValueError
        If fewer than 10 ions are of the precipitate, or they lie in a plane.

    Notes
    -----
    The semi-axis of a uniform ellipsoid is :math:`\sqrt{5}` times its standard deviation along this axis. The ions
    within an ellipsoid are those with :math:`(r - m)^T C^{-1} (r - m) \le 5`, with mean m and covariance C of the ions
    of the precipitate.
    """
    check_kind(reconstruction, "reconstruction", Reconstruction, "a Reconstruction")
    belongs = per_ion(inside, "inside", reconstruction.hits, truth, bool)
    if np.count_nonzero(belongs) < _FEWEST:
        raise ValueError(f"inside must mark at least {_FEWEST} ions, got {np.count_nonzero(belongs)}")
    sites = true_sites(reconstruction.hits, truth)
    kinds = groups_of(reconstruction.hits, truth, species, "species")
    kinds = belongs.astype(np.int64) if kinds is None else kinds
    positions = reconstruction.fitted_positions(truth, fit) if fit else reconstruction.positions
    apparent, shape = ellipsoid_of(positions, belongs)
    original, true_shape = ellipsoid_of(sites, belongs)
    numbers = np.unique(kinds[belongs | apparent])
    fractions = [np.array([np.mean(kinds[chosen] == number) for number in numbers]) for chosen in (belongs, apparent)]
    return PrecipitateErrors(
        ions=int(np.count_nonzero(belongs)),
        true=true_shape,
        apparent=shape,
        overlap=float(np.mean(~belongs[apparent])),
        lost=float(np.mean(~apparent[belongs])),
        true_overlap=float(np.mean(~belongs[original])),
        true_lost=float(np.mean(~original[belongs])),
        species=numbers,
        true_composition=fractions[0],
        apparent_composition=fractions[1],
        composition_errors=np.sqrt(fractions[1] * (1 - fractions[1]) / np.count_nonzero(apparent)),
    )


def ellipsoid_of(positions: Floats, belongs: Booleans) -> tuple[Booleans, SemiAxes]:
    """Ions within the ellipsoid of the second moments of some ions, and its semi-axes."""
    cloud = positions[belongs]
    mean = cloud.mean(axis=0)
    covariance = np.cov(cloud.T)
    if not np.linalg.eigvalsh(covariance)[0] > 0:
        raise ValueError(
            f"the precipitate must have an extent in all directions, got {short_text(np.ptp(cloud, 0))} nm"
        )
    away = positions - mean
    within = np.einsum("ni,ij,nj->n", away, np.linalg.inv(covariance), away) <= 5
    lateral, depth = 5 * (covariance[0, 0] + covariance[1, 1]) / 2, 5 * covariance[2, 2]
    return within, SemiAxes(math.sqrt(lateral), math.sqrt(depth))
