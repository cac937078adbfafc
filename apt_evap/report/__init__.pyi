# The reports: read by type checkers, and by the lazy loader in __init__.py.
from .page import read as read
from .study import doubts as doubts
from .study import write_study as write_study
from .sweep import SweepRow as SweepRow
from .sweep import write_sweep as write_sweep
