"""Reconstructed ions of a simulated feature, beside their true sites."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from apt_evap._common.short_repr import short_repr
from apt_evap._common.types import Booleans, Floats
from apt_evap.detection.instrument import Instrument
from apt_evap.emission.perturbations import Perturbation
from apt_evap.reconstruction.errors import FREE
from apt_evap.reconstruction.reconstruct import reconstruct
from apt_evap.simulation.run import Run
from apt_evap.specimen.lattice import atom_density

_START = 1.2  # compression from which the fit starts; the result does not depend on it


class Ions(NamedTuple):
    """Reconstructed ions of a specimen with a feature, in the coordinates of the specimen."""

    positions: Floats
    """Reconstructed positions [nm], shape (n, 3), with z out of the specimen."""
    labels: NDArray[np.int64]
    """Element of each ion, as an index into the names of the elements in alphabetical order, shape (n,)."""
    inside: Booleans
    """Whether the ion belongs to the feature, shape (n,)."""
    sites: Floats
    """True sites [nm], shape (n, 3)."""

    def __repr__(self) -> str:
        return short_repr(self)


def names_of(elements: tuple) -> tuple[list[str], NDArray[np.int64]]:
    """Names of the elements in alphabetical order, and the label of each species: fields are not seen by the mass."""
    names = sorted({str(getattr(element, "name", element)) for element in elements})
    return names, np.array([names.index(str(getattr(element, "name", element))) for element in elements])


def recorded_ions(
    run: Run, instrument: Instrument | None = None, perturbation: Perturbation | None = None, seed: int = 0
) -> Ions:
    """Reconstruct what an instrument records of a run, with the constants that fit the true sites best.

    Examples
    --------
    >>> tip = ae.Tip("Ni", apex_radius=2.5, solutes={"Al": 0.1}, seed=1)
    >>> run = ae.Simulation(tip, seed=1).run(300, [ae.Unperturbed()], responses=False)
    >>> from apt_evap.studies.visibility.recorded import recorded_ions
    >>> recorded_ions(run).positions.shape
    (193, 3)
    """
    instrument = Instrument(field_of_view=160.0) if instrument is None else instrument
    real = run.in_real_units()
    tip = run.settings["tip"]
    if "apex_radius" not in tip:
        raise ValueError("run must be of a tip with an apex_radius, got a specimen from positions")
    host = tip["material"] if "material" in tip else tip["phases"][0]["material"]
    reconstruction = reconstruct(
        real.record(instrument, perturbation, seed=seed),
        atomic_volume=1 / atom_density(host["structure"], host["a"], host["c"]),
        distance=instrument.distance,
        detector_radius=instrument.field_of_view / 2,
        efficiency=instrument.efficiency,
        radius=tip["apex_radius"],
        projection="equidistant" if instrument.projection == "equidistant" else "compressed",
        compression=_START,
    )
    hits = reconstruction.hits
    species = hits.extra["species"].astype(np.int64)
    phase = hits.extra.get("phase")
    inside = np.zeros(len(hits), dtype=bool) if phase is None else phase == len(run.phase_names) - 1
    sites = np.asarray(hits.positions)
    return Ions(reconstruction.fitted_positions(run, FREE), names_of(run.elements)[1][species], inside, sites)
