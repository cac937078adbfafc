# The public names of this room: read by type checkers, and by the lazy loader in __init__.py.
from .distortion import DistortionGrid as DistortionGrid
from .hits import Outcome as Outcome
from .instrument import PRESETS as PRESETS
from .instrument import Detection as Detection
from .instrument import Recording as Recording
from .mass_ranges import Ranges as Ranges
from .projection import Projection as Projection
from .timing import Cooling as Cooling
from .timing import Timing as Timing
from .timing import mass_to_charge as mass_to_charge
