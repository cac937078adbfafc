# The public names of this room: read by type checkers, and by the lazy loader in __init__.py.
from .estimate import MeasuredError as MeasuredError
from .estimate import SizedTwins as SizedTwins
from .estimate import TrueSize as TrueSize
from .estimate import Visibility as Visibility
from .estimate import estimate as estimate
from .estimate import permutation_p_value as permutation_p_value
from .operators import OriginOperators as OriginOperators
from .operators import origin_operators as origin_operators
from .order import Estimated as Estimated
from .order import FalseOrder as FalseOrder
from .order import false_order as false_order
from .order import warren_cowley as warren_cowley
from .recorded import Ions as Ions
from .recorded import recorded_ions as recorded_ions
from .settings_file import VisibilitySettings as VisibilitySettings
from .settings_file import estimate_of_file as estimate_of_file
