# The public names of this package: read by type checkers, and by the lazy loader in __init__.py.
from .lens_text import read_lens as read_lens
from .map_panels import MapSettings as MapSettings
from .map_panels import Panel as Panel
from .perturbation_text import read_perturbation as read_perturbation
from .simulation_file import read_config as read_config
