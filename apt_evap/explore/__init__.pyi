# The public names of this room: read by type checkers, and by the lazy loader in __init__.py.
from .controls import Control as Control
from .controls import controls_of as controls_of
from .controls import perturbation_of as perturbation_of
from .controls import values_of as values_of
from .explorer import Commands as Commands
from .explorer import Explorer as Explorer
from .explorer import Pole as Pole
from .explorer import Shown as Shown
from .explorer import View as View
from .specimen_surface import SurfaceAtoms as SurfaceAtoms
from .specimen_surface import surface_atoms as surface_atoms
