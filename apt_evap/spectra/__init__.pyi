# The public names of this package: read by type checkers, and by the lazy loader in __init__.py.
from .composition import Composition as Composition
from .mass_ranges import Ranges as Ranges
from .mass_spectrum import Spectrum as Spectrum
