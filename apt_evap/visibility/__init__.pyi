# The public names of this room: read by type checkers, and by the lazy loader in __init__.py.
from .order import Estimated as Estimated
from .order import FalseOrder as FalseOrder
from .order import false_order as false_order
from .order import warren_cowley as warren_cowley
from .recorded import Ions as Ions
from .recorded import recorded_ions as recorded_ions
