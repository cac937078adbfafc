# The public names of this room: read by type checkers, and by the lazy loader in __init__.py.
from .start import Start as Start
from .start import settings_of as settings_of
