# The public names of this room: read by type checkers, and by the lazy loader in __init__.py.
from .settings_of import Start as Start
from .settings_of import settings_of as settings_of
