# The public names of this room: read by type checkers, and by the lazy loader in __init__.py.
from .index import Candidate as Candidate
from .index import Indexing as Indexing
from .master_pattern import MasterPattern as MasterPattern
from .master_pattern import master_patterns as master_patterns
