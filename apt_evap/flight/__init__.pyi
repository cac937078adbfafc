# The public names of this room: read by type checkers, and by the lazy loader in __init__.py.
from .designs import Design as Design
from .designs import WideDesign as WideDesign
from .response import Responses as Responses
