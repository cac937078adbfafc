# The public names of this room: read by type checkers, and by the lazy loader in __init__.py.
from .grid import EnergyGrid as EnergyGrid
from .radius import RadiusFit as RadiusFit
from .radius import fit_radius as fit_radius
from .settings import FitSettings as FitSettings
from .structure import Structure as Structure
from .structure import StructureScores as StructureScores
from .study import Optimum as Optimum
from .study import Score as Score
from .study import Study as Study
from .tips import TipFit as TipFit
from .tips import fit_tips as fit_tips
