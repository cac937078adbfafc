# The public names of this package: read by type checkers, and by the lazy loader in __init__.py.
from .explorer import Explorer as Explorer
from .explorer import ExplorerSettings as ExplorerSettings
from .specimen_surface import surface_atoms as surface_atoms
