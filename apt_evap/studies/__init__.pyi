# The public names of this package: read by type checkers, and by the lazy loader in __init__.py.
from .dataset.dataset_settings import DatasetSettings as DatasetSettings
from .dataset.making import make_dataset as make_dataset
from .dataset.making import plan_dataset as plan_dataset
from .dataset.set_description import verify_dataset as verify_dataset
from .sweep.collection import collect_sweep as collect_sweep
from .sweep.planning import open_sweep as open_sweep
from .sweep.planning import plan_sweep as plan_sweep
from .sweep.planning import sweep_status as sweep_status
from .sweep.point_folder import run_point as run_point
from .sweep.working import run_sweep as run_sweep
from .sweep.working import run_sweep_with_dask as run_sweep_with_dask
from .visibility.false_order import false_order as false_order
from .visibility.operators import OriginOperators as OriginOperators
from .visibility.operators import origin_operators as origin_operators
from .visibility.probability import estimate_visibility as estimate_visibility
from .visibility.visibility_file import VisibilitySettings as VisibilitySettings
from .visibility.visibility_file import visibility_of_file as visibility_of_file
