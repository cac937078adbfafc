# The public names of this package: read by type checkers, and by the lazy loader in __init__.py.
from .correlation import Correlation as Correlation
from .correlation import dissociation_line as dissociation_line
from .hits import Outcome as Outcome
from .instrument import Detection as Detection
from .microscope.local_electrode import LocalElectrode as LocalElectrode
from .microscope.run_lens import field_of_view as field_of_view
from .projection import Projection as Projection
from .timing import Cooling as Cooling
from .timing import Timing as Timing
from .timing import mass_to_charge as mass_to_charge
