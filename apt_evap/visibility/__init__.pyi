# The public names of this room: read by type checkers, and by the lazy loader in __init__.py.
from .operators import OriginOperators as OriginOperators
from .operators import origin_operators as origin_operators
from .order import Estimated as Estimated
from .order import FalseOrder as FalseOrder
from .order import false_order as false_order
from .order import warren_cowley as warren_cowley
from .probability import MeasuredError as MeasuredError
from .probability import SizedTwins as SizedTwins
from .probability import TrueSize as TrueSize
from .probability import Visibility as Visibility
from .probability import estimate as estimate
from .probability import permutation_p_value as permutation_p_value
from .recorded import Ions as Ions
from .recorded import recorded_ions as recorded_ions
from .settings_file import VisibilitySettings as VisibilitySettings
from .settings_file import estimate_of_file as estimate_of_file
