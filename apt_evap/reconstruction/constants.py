"""Constants of a reconstruction that a simulated run determines: its own field factor, compression and material."""

from typing import Any

import numpy as np

from apt_evap._common.validation import check_kind, check_number
from apt_evap.simulation.apex import fit_caps, image_compression
from apt_evap.simulation.run import Run
from apt_evap.specimen.lattice import atom_density


def run_constants(run: Run, evaporation_field: float | None = None) -> dict[str, Any]:
    """Constants for the reconstruction of a run: ``reconstruct(run.hits(perturbation), **run_constants(run))``.

    Parameters
    ----------
    run : Run
        A run in real units, see `Run.at_evaporation_field`.
    evaporation_field : float, optional
        F in V = k_f F R [V/nm]; by default the operating field of the run.

    Returns
    -------
    dict
        * ``distance``: that of the detector [mm];
        * ``efficiency``: 1, every ion that reaches the detector is in a run;
        * ``detector_radius``: of the circle inside the square detector, or of the image of the lens [mm];
        * ``atomic_volume`` [nm^3] and ``evaporation_field``: of the first species. Without the former for a specimen
          from positions, whose volume is not known;
        * ``field_factor``: the median of V / (F R) over all ions, with the spheres of `fit_caps` for R; with too few
          ions for a sphere, with the radius of the tip;
        * ``compression`` and ``projection``: those of `image_compression`, without them if the ions do not suffice for
          a fit;
        * ``lens`` in place of the last three, if the run has one.

    Raises
    ------
    ValueError
        If the run is not in real units, or if too few ions of a specimen from positions are near the axis for a sphere.
    """
    units = check_kind(run, "run", Run, "a Run").require_real_units("the field factor")
    if evaporation_field is None:
        field = units.operating_field
    else:
        field = check_number(evaporation_field, "evaporation_field", above=0, unit="V/nm")
    voltages = run.instrument_voltages
    constants: dict[str, Any] = {
        "distance": run.detector.distance,
        "efficiency": 1.0,
        "detector_radius": run.detector.width / 2,
        "evaporation_field": field,
        "field_factor": float(np.median(voltages / (field * _radii(run)))),
    }
    tip = run.settings["tip"]
    if "material" in tip or "phases" in tip:  # not of a specimen from positions
        host = tip["material"] if "material" in tip else tip["phases"][0]["material"]
        constants["atomic_volume"] = 1 / atom_density(host["structure"], host["a"], host["c"])
    try:
        constants["compression"] = image_compression(run).compression
        constants["projection"] = "compressed"
    except ValueError:  # too few ions
        pass
    if of_lens := run.observation.lens.constants(voltages, run.detector.distance):
        for name in ("field_factor", "compression", "projection"):
            constants.pop(name, None)
        constants["lens"] = of_lens["lens"]
        constants["detector_radius"] = min(constants["detector_radius"], of_lens["rim"])
    return constants


def _radii(run):
    """Radius of the cap at each ion [nm], shape (n,)."""
    try:
        return np.concatenate([np.full(cap.last - cap.first, cap.radius) for cap in fit_caps(run)])
    except ValueError:  # too few ions
        if "apex_radius" not in run.settings["tip"]:
            raise
        return np.full(len(run), run.settings["tip"]["apex_radius"])
