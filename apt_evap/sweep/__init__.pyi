# The public names of this room: read by type checkers, and by the lazy loader in __init__.py.
from .collection import collect as collect
from .planning import Sweep as Sweep
from .planning import open_sweep as open_sweep
from .planning import plan as plan
from .planning import retry as retry
from .planning import status as status
from .point_folder import PointState as PointState
from .point_folder import run_point as run_point
from .study_file import JobSettings as JobSettings
from .study_file import Point as Point
from .working import work as work
from .working import work_with_dask as work_with_dask
