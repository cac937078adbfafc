# The public names of this room: read by type checkers, and by the lazy loader in __init__.py.
from .cost_estimate import CostEstimate as CostEstimate
from .lens_text import read_lens as read_lens
from .map_panels import MapSettings as MapSettings
from .map_panels import Panel as Panel
from .perturbation_text import read_perturbation as read_perturbation
from .perturbation_text import write_perturbation as write_perturbation
from .simulation_file import Config as Config
from .simulation_file import read_config as read_config
