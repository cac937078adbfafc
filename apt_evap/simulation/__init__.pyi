# The public names of this room: read by type checkers, and by the lazy loader in __init__.py.
from .checkpoint import Checkpoint as Checkpoint
from .columns import Clock as Clock
from .columns import Column as Column
from .columns import Flown as Flown
from .history import CapHistory as CapHistory
from .history import History as History
from .monitor import Monitor as Monitor
from .monitor import charge_residuals as charge_residuals
from .real_units import OperatingPoint as OperatingPoint
from .real_units import RealColumns as RealColumns
from .real_units import RealUnits as RealUnits
from .recorder import RunInterrupted as RunInterrupted
from .recorder import RunNotSaved as RunNotSaved
from .stop_reason import StopReason as StopReason
from .surface import surface_after as surface_after
