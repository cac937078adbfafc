"""Where the ions of a place on the detector came from, counted in simulated runs, and the correction by it."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
import scipy
from numpy.typing import ArrayLike

from apt_evap._common.codec import check_itself
from apt_evap._common.files import FileError, open_for_reading, replace_file
from apt_evap._common.types import AnyPath, Floats
from apt_evap._common.validation import (
    check_array,
    check_count,
    check_kind,
    check_number,
    check_sequence,
    check_switch,
)
from apt_evap.emission.perturbations import Perturbation, Unperturbed
from apt_evap.simulation.apex import fit_caps, image_compression
from apt_evap.simulation.run import Run
from apt_evap.specimen.lattice import rotation_to_axis
from apt_evap.specimen.materials import Material
from apt_evap.specimen.symmetry import symmetry_about_axis

NEIGHBOURS = 16
"""Ions of a mean. Measured with 4 runs of 8,000 ions of Ni[111], R = 14 a: 10, 25 and 50 of three runs leave 0.229,
0.236 and 0.245 of the RMS lateral error of the fourth."""

_CHUNK = 65_536  # places at a time
_ARRAYS = ("places", "shifts", "neighbours", "compression", "symmetry")


@dataclass(frozen=True, eq=False)
class OriginTable:
    """True lateral places of ions, by the place on the cap that the ideal projection of their hits gives.

    Returned by `origin_table`. Places are x / R and y / R from the axis of a cap of radius R, in the frame of the
    simulated specimen.

    Parameters
    ----------
    places : ndarray
        Place of each ion by the ideal projection, shape (n, 2).
    shifts : ndarray
        True place minus this place, shape (n, 2).
    neighbours : int
        Number of nearest ions of which mean and covariance are taken.
    compression : float
        Image compression of the ideal projection, mean over the runs.
    symmetry : int
        Number of symmetric copies of each simulated ion.
    """

    places: Floats = field(repr=False)
    shifts: Floats = field(repr=False)
    neighbours: int = NEIGHBOURS
    compression: float = math.nan
    symmetry: int = 1

    def __post_init__(self):
        check_itself(self)

    def _check(self):
        places, shifts = (check_array(getattr(self, name), name, ("n", 2)) for name in ("places", "shifts"))
        if len(places) != len(shifts):
            raise ValueError(f"places and shifts must have equal lengths, got {len(places)}, {len(shifts)}")
        neighbours = check_count(self.neighbours, "neighbours", at_least=3)
        if len(places) < neighbours:
            raise ValueError(f"a table needs at least {neighbours} ions, got {len(places)}")
        return {"places": places, "shifts": shifts, "neighbours": neighbours, "_tree": scipy.spatial.cKDTree(places)}

    def __len__(self) -> int:
        return len(self.places)

    def __repr__(self) -> str:
        copies = f" with {self.symmetry} symmetric copies each" if self.symmetry > 1 else ""
        return (
            f"<OriginTable: {len(self) // self.symmetry:,} ions{copies}, to {math.degrees(math.asin(self.rim)):.0f} "
            f"degrees, mean shift {np.hypot(*self.shifts.T).mean():.3f} R; means of {self.neighbours} ions>"
        )

    @property
    def rim(self) -> float:
        """Largest distance of a place from the axis, up to which the table is used, in units of the radius."""
        return min(1.0, float(np.hypot(*self.places.T).max()))

    def shifts_at(self, places: ArrayLike) -> tuple[Floats, Floats]:
        """Mean shift of the ions of each place, and covariance of their true places.

        Parameters
        ----------
        places : array_like
            x / R and y / R by the ideal projection of the hits, shape (n, 2).

        Returns
        -------
        shifts : ndarray
            Mean true place minus this place, shape (n, 2).
        covariances : ndarray
            Covariance of the true place of one ion about its mean, shape (n, 2, 2), with the error of the mean.

        Raises
        ------
        ValueError
            If places are outside those of the table.

        Notes
        -----
        Mean and covariance are those of the k nearest ions; the covariance is multiplied by 1 + 1/k. The shifts are
        averaged, not the places, so that a gradient of the density of hits gives no error of first order.
        """
        places = check_array(places, "places", ("n", 2))
        distance = float(np.hypot(*places.T).max(initial=0.0))
        if distance > self.rim:
            raise ValueError(
                f"places must be within {self.rim:.3f} R of the axis, which the origins cover, got {distance:.3f} R: "
                "reduce detector_radius or compression"
            )
        means, covariances = np.empty_like(places), np.empty((len(places), 2, 2))
        k = self.neighbours
        for first in range(0, len(places), _CHUNK):
            part = slice(first, first + _CHUNK)
            _, nearest = self._tree.query(places[part], k=k)  # type: ignore[attr-defined]
            shifts = self.shifts[nearest]
            means[part] = shifts.mean(axis=1)
            deviations = shifts - means[part, None]
            covariances[part] = np.einsum("nki,nkj->nij", deviations, deviations) / (k - 1) * (1 + 1 / k)
        return means, covariances

    def rotated(self, angle: float) -> OriginTable:
        """The table of a specimen that is rotated about its axis.

        Parameters
        ----------
        angle : float
            Counter-clockwise as seen from the detector [degrees].

        Returns
        -------
        OriginTable
        """
        turn = math.radians(check_number(angle, "angle", unit="degrees"))
        matrix = np.array([[math.cos(turn), -math.sin(turn)], [math.sin(turn), math.cos(turn)]])
        return OriginTable(
            self.places @ matrix.T, self.shifts @ matrix.T, self.neighbours, self.compression, self.symmetry
        )

    def save(self, path: AnyPath) -> None:
        """Write the table to an .npz file.

        Parameters
        ----------
        path : str or path-like
            The file to write or overwrite.

        Raises
        ------
        FileError
            If it cannot be written.
        """
        with replace_file(path) as file:
            np.savez(file, **{name: getattr(self, name) for name in _ARRAYS})

    @classmethod
    def load(cls, path: AnyPath) -> OriginTable:
        """Read a table from a file of `save`.

        Parameters
        ----------
        path : str or path-like
            The file.

        Returns
        -------
        OriginTable

        Raises
        ------
        FileError
            If it is missing, damaged or not a table of origins.
        """
        with open_for_reading(path) as file:
            try:
                with np.load(file, allow_pickle=False) as archive:
                    arrays = {name: archive[name] for name in _ARRAYS}
                scalars = {name: arrays.pop(name).item() for name in _ARRAYS[2:]}
                return cls(**arrays, **scalars)
            except Exception as error:  # every kind of damage has its own errors
                reason = (str(error) or type(error).__name__).splitlines()[0]
                raise FileError(f"{str(path)!r} is not a table of origins: {reason}") from error


def origin_table(
    runs: Run | Sequence[Run],
    perturbation: Perturbation | None = None,
    *,
    neighbours: int = NEIGHBOURS,
    symmetry: bool = True,
) -> OriginTable:
    """Count in simulated runs where the ions of each place on the detector came from.

    Parameters
    ----------
    runs : Run or sequence of Run
        Runs of one material with one orientation. Different `offset_seed` of their tips average over the terraces.
    perturbation : perturbation, optional
        Initial conditions of the ions; by default `Unperturbed`.
    neighbours : int
        Number of ions of which mean and covariance are taken.
    symmetry : bool
        Whether to add the symmetric copies of each ion, by the symmetry of the crystal about the axis. It does not
        apply to tips made from positions.

    Returns
    -------
    OriginTable

    Raises
    ------
    ValueError
        If there is no run, the runs have different crystals or orientations, or too few ions hit the detector.

    Notes
    -----
    For the ideal projection each run is taken by itself: true places are those about the spheres of `fit_caps`, and the
    projection is that of `image_compression` with them. The table is therefore as valid for another radius, distance or
    compression as the pattern of the map is.
    """
    runs = [runs] if isinstance(runs, Run) else list(check_sequence(runs, "runs", "Run"))
    if not runs:
        raise ValueError("runs must contain at least one run, got none")
    perturbation = Unperturbed() if perturbation is None else perturbation
    check_switch(symmetry, "symmetry")
    crystals = [_crystal(check_kind(run, "runs", Run, "a sequence of Run")) for run in runs]
    for crystal in crystals:
        if crystal != crystals[0]:
            raise ValueError(f"runs must have the same crystal and orientation, got {crystals[0]} and {crystal}")
    places, shifts, compressions = [], [], []
    for run in runs:
        caps = fit_caps(run)
        projection = image_compression(run, caps)
        hits = run.hits(perturbation)
        true = np.empty((len(run), 2))
        for cap in caps:
            sites = run.emissions.positions[cap.first : cap.last]
            true[cap.first : cap.last] = (sites - cap.centre)[:, :2] / cap.radius
        chosen = hits.detected
        ideal = projection.projection.directions(np.column_stack([hits.x, hits.y])[chosen])  # type: ignore[list-item]
        front = ideal[:, 2] > 0  # a wide detector also sees ions from the shank
        places.append(ideal[front, :2])
        shifts.append(true[chosen][front] - ideal[front, :2])
        compressions.append(projection.compression)
    turns = _turns(runs[0]) if symmetry else np.eye(2)[None]
    placed, shifted = (np.concatenate([np.concatenate(parts) @ turn.T for turn in turns]) for parts in (places, shifts))
    return OriginTable(placed, shifted, neighbours, float(np.mean(compressions)), len(turns))


def _crystal(run):
    """Material, axis and rotation of the specimen of a run, for comparison."""
    tip = run.settings["tip"]
    if "material" not in tip:
        return tuple(element["name"] for element in tip.get("elements", ())), None, None
    return tip["material"]["name"], tuple(tip["axis"]), tip["rotation"]


def _turns(run):
    """Symmetry of the specimen of a run about its axis, shape (n, 2, 2)."""
    tip = run.settings["tip"]
    if "material" not in tip:
        return np.eye(2)[None]
    host = Material(**tip["material"])
    return symmetry_about_axis(host, rotation_to_axis(host, tip["axis"], tip["rotation"]))
