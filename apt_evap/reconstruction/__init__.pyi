# The public names of this package: read by type checkers, and by the lazy loader in __init__.py.
from .assumed_constants import assumptions as assumptions
from .calibration import compression_from_poles as compression_from_poles
from .calibration import distribution_map as distribution_map
from .consistency import checks as checks
from .constants import run_constants as run_constants
from .evolving import EvolvingReconstruction as EvolvingReconstruction
from .lattice_planes import LatticePlanes as LatticePlanes
from .lattice_planes import find_planes as find_planes
from .origins import origin_table as origin_table
from .position_errors import local_scatter as local_scatter
from .position_errors import position_covariances as position_covariances
from .precipitate import precipitate_errors as precipitate_errors
from .reconstruction_settings import ReconstructionSettings as ReconstructionSettings
from .shank import fit_shank as fit_shank
from .truth_comparison import compare_with_truth as compare_with_truth
from .truth_comparison import corrected as corrected
