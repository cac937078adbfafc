# The public names of this package: read by type checkers, and by the lazy loader in __init__.py.
from .checkpoint import Checkpoint as Checkpoint
from .flight.flight_pool import FlightSettings as FlightSettings
from .flight.launch_designs import Design as Design
from .monitor import Monitor as Monitor
from .real_units import OperatingPoint as OperatingPoint
from .recorder import RunInterrupted as RunInterrupted
from .recorder import RunNotSaved as RunNotSaved
from .surface import surface_after as surface_after
