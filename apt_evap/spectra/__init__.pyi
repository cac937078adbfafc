# The public names of this package: read by type checkers, and by the lazy loader in __init__.py.
from .mass_ranges import Ranges as Ranges
