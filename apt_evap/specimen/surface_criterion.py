"""Criteria for surface atoms and nearest neighbours: distances in units of the nearest neighbour distance."""

from dataclasses import dataclass

from apt_evap.specimen import lattice


@dataclass(frozen=True)
class SurfaceCriterion:
    """Distances that define surface atoms and nearest neighbours.

    An atom is a surface atom if its distance from the mean position of its neighbourhood exceeds a threshold (Rolland
    et al., Microsc. Microanal. 21, 1649, 2015).

    Parameters
    ----------
    nearest_neighbour_distance : float
        d_nn [nm].
    neighbour_radius : float
        Radius of the neighbourhood [nm], see `lattice.SURFACE_FACTORS`.
    surface_threshold : float
        Smallest distance of a surface atom from the mean of its neighbourhood [nm].
    bond_length : float
        Atoms closer than this are nearest neighbours [nm], see `lattice.BOND_FACTORS`.
    """

    nearest_neighbour_distance: float
    neighbour_radius: float
    surface_threshold: float
    bond_length: float

    @classmethod
    def of(cls, structure: str, distance: float) -> "SurfaceCriterion":
        """Return the criterion of a crystal structure with a nearest neighbour distance [nm]."""
        radius, threshold = lattice.SURFACE_FACTORS[structure]
        return cls(distance, radius * distance, threshold * distance, lattice.BOND_FACTORS[structure] * distance)
