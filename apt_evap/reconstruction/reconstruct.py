"""Reconstruction: positions of the ions in the specimen from their hits and their sequence."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from numpy.typing import ArrayLike

from apt_evap._common.validation import check_choice, check_kind, short_text
from apt_evap.detection.hits import Hits, MassRanges
from apt_evap.reconstruction.evolving import follow_surface
from apt_evap.reconstruction.origins import OriginTable
from apt_evap.reconstruction.reconstructed import Reconstruction, cap_reconstruction
from apt_evap.reconstruction.reconstruction_settings import ReconstructionSettings, resolved_settings
from apt_evap.simulation.run import Run

SHAPES = ("cap", "evolving")
"""Surfaces: a sphere, or the shape that is integrated from the ions."""


def reconstruct(
    hits: Hits,
    settings: ReconstructionSettings | None = None,
    *,
    shape: str = "cap",
    ranges: MassRanges | None = None,
    solutes: Sequence[str] = (),
    labels: ArrayLike | None = None,
    origins: OriginTable | None = None,
    twin: Run | None = None,
    **constants: Any,
) -> Reconstruction:
    r"""Reconstruct the positions of ions from their hits.

    Parameters
    ----------
    hits : Hits
        Ions in the sequence of evaporation, simulated or measured. Ions that did not hit the detector are left out.
    settings : ReconstructionSettings, optional
        Protocol, projection and constants.
    shape : {"cap", "evolving"}
        "cap": the surface stays a sphere. "evolving": its shape is integrated from the ions, see
        :doc:`/evolving_surface`; phases with another evaporation field keep their size and density.
    ranges : Ranges, optional
        Ranges of the mass-to-charge ratio, for `solutes`. Simulated ions have their elements.
    solutes : sequence of str
        Species whose local composition changes the evaporation field, for an evolving shape.
    labels : array_like of int, optional
        Phase of each of the hits in place of solutes, shape (n,). The most frequent one is the matrix.
    origins : OriginTable, optional
        Table of where the ions of simulated hits came from. Lateral positions are corrected by it, and get covariances.
        The hits must have the axes of the simulated specimen.
    twin : Run, optional
        Simulated run of the matrix alone, in the orientation of the measurement and with its emission as the first one
        that was flown, for an evolving shape. The mean errors of its reconstruction at the place of each ion are taken
        off, if its density on the detector describes the measured one better than an even one: the verdict says so.
    **constants
        Fields of `ReconstructionSettings` by name, instead of the object, or to replace some of its fields.

    Returns
    -------
    Reconstruction
        With an evolving shape an `EvolvingReconstruction`.

    Raises
    ------
    ValueError
        If a constant that the choices need is missing, an argument is unknown or out of range, a column is missing, or
        no ion hit the detector.

    Notes
    -----
    The voltage of an ion is the sum of the standing voltage and the voltage pulse, if there is one: it leaves at the
    top of the pulse. For field factors of the standing voltage alone, use `dataclasses.replace` with
    ``pulse_voltage=None``.

    With the distance rho of an ion from the centre of the detector, the flight length L and
    :math:`\tan\theta' = \rho/L`, the angle on the cap is

    * bas: :math:`\theta = \theta' + \arcsin((\xi-1)\sin\theta')`, a projection from a point behind the centre of the
      cap;
    * equidistant: :math:`\theta = \xi\rho/L` (De Geuser and Gault, Microsc. Microanal. 23, 238 (2017));
    * compressed: :math:`\theta = \xi\theta'`, as in `Projection` and `image_compression`.

    The position is :math:`R\sin\theta` from the axis, at the depth :math:`z + R(1-\cos\theta)`, where z is the depth
    of the apex. With the volume Omega of an atom, the efficiency eta and the angle :math:`\theta_m` at the rim of the
    field of view, the volume of the ions equals the volume that the cap sweeps:

    .. math:: \Omega/\eta = \pi R^2 \, [\sin^2\theta_m \, dz - (1-\cos\theta_m)^2 \, dR]   \quad \text{(cap)}

    with the mean of :math:`R^2` between both ions. Bas et al., Appl. Surf. Sci. 87/88, 298 (1995) and Gault et al.,
    Ultramicroscopy 111, 448 (2011) use the area A of the detector:
    :math:`\Omega/\eta = A \xi^2 R^2 dz / L^2`. On a shank of half angle alpha,
    :math:`dR = dz \sin\alpha/(1-\sin\alpha)`.

    Examples
    --------
    >>> run = ae.Simulation(ae.Tip("Ni", apex_radius=2.0, axis=(1, 1, 1)), seed=1).run(200)
    >>> hits = run.at_evaporation_field(field_factor=3.3).hits(ae.Unperturbed())
    >>> settings = ae.reconstruction.ReconstructionSettings(distance=100.0, element="Ni", detector_radius=80.0)
    >>> ae.reconstruct(hits, settings, projection="compressed", compression=1.13)
    <Reconstruction: 129 ions, 2.6 x 2.5 x 0.6 nm, cap, compressed, R 2.0 to 2.0 nm (voltage); field_factor 3.3,
    evaporation_field 35, compression 1.13, efficiency 1>
    """
    check_kind(hits, "hits", Hits, "Hits, such as read(path) or run.hits(perturbation)")
    if ranges is not None:
        check_kind(ranges, "ranges", "species", "Ranges, such as ae.io.read_ranges(path)")
    if origins is not None:
        check_kind(origins, "origins", OriginTable, "an OriginTable, such as origin_table(runs)")
    if twin is not None:
        check_kind(twin, "twin", Run, "a Run, such as ae.load(path)")
    chosen = check_choice(shape, "shape", SHAPES)
    if chosen == "cap":
        for name, value in (("solutes", solutes), ("labels", labels)):
            if value is not None and not (isinstance(value, tuple | list) and not value):
                raise ValueError(f'{name} are for shape="evolving", got {short_text(value)} and shape="cap"')
        if twin is not None:
            raise ValueError('twin is for shape="evolving", got a run and shape="cap", for which origins are')
        return cap_reconstruction(hits, resolved_settings(settings, constants), origins)[0]
    if origins is not None:
        raise ValueError('origins must be None with shape="evolving", whose positions a table of a sphere would move')
    return follow_surface(hits, resolved_settings(settings, constants), ranges, solutes, labels, twin)
