# The public names of this package: read by type checkers, and by the lazy loader in __init__.py.
from .alloy import Segregation as Segregation
from .lattice import atom_density as atom_density
from .lattice import rotation_to_axis as rotation_to_axis
from .ordered import Superlattice as Superlattice
from .ordered import UnitCell as UnitCell
from .phases import Phase as Phase
from .regions import Box as Box
from .regions import CoreShell as CoreShell
from .regions import Cylinder as Cylinder
from .regions import Ellipsoid as Ellipsoid
from .regions import HalfSpace as HalfSpace
from .regions import Layer as Layer
from .regions import Sphere as Sphere
from .regions import Union as Union
