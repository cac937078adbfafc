"""What the studies of this folder share: an instrument, and the reconstruction of the ions that it records."""

import apt_evap as ae

INSTRUMENT = ae.Instrument(distance=100.0, field_of_view=160.0, efficiency=0.8)
FIT = ("shift", "rotation", "depth_scale", "radius", "compression")


def reconstruct(run, radius, material):
    """Reconstruction of the recorded ions of an fcc specimen with a known radius [nm]."""
    return ae.reconstruct(
        run.at_evaporation_field().record(INSTRUMENT),
        atomic_volume=material.a**3 / 4,
        distance=INSTRUMENT.distance,
        detector_radius=INSTRUMENT.field_of_view / 2,
        efficiency=INSTRUMENT.efficiency,
        radius=radius,
        projection="compressed",
        compression=1.2,  # where the fit against the true sites starts
    )
