# The public names of this package: read by type checkers, and by the lazy loader in __init__.py.
from .crystal_constants import constants_of_crystal as constants_of_crystal
from .fit_settings import FitSettings as FitSettings
from .grid import EnergyGrid as EnergyGrid
from .measured_constants import constants_of as constants_of
from .pattern_of_runs import master_pattern as master_pattern
from .radius import fit_radius as fit_radius
from .start_settings import settings_of as settings_of
from .tips import fit_tips as fit_tips
