# The public names of this package: read by type checkers, and by the lazy loader in __init__.py.
from .distortion_grid import read_grid as read_grid
from .formats import chunks as chunks
from .formats import read_ranges as read_ranges
from .mesh import read_mesh as read_mesh
from .npz import read_map as read_map
from .rrng import write_rrng as write_rrng
from .tapsim_nodes import write_nodes as write_nodes
from .tapsim_nodes import write_types as write_types
