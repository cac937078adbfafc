# The public names of this room: read by type checkers, and by the lazy loader in __init__.py.
from .constants import Constant as Constant
from .constants import Measurement as Measurement
from .constants import Observed as Observed
from .constants import constants_of as constants_of
from .start import Start as Start
from .start import settings_of as settings_of
