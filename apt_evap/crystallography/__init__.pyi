# The public names of this room: read by type checkers, and by the lazy loader in __init__.py.
from .directions import Poles as Poles
from .directions import Zones as Zones
from .directions import direction_normals as direction_normals
from .directions import plane_normals as plane_normals
from .directions import poles as poles
from .directions import zones as zones
from .orientation import FittedOrientation as FittedOrientation
from .orientation import fit_orientation as fit_orientation
from .symmetry import PoleSymmetry as PoleSymmetry
from .symmetry import point_group as point_group
from .symmetry import pole_symmetry as pole_symmetry
from .symmetry import symmetry_about_axis as symmetry_about_axis
