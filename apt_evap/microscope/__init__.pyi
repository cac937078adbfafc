# The microscope: read by type checkers, and by the lazy loader in __init__.py.
from .lens import Lens as Lens
from .local_electrode import PRESETS as PRESETS
from .local_electrode import LensProjection as LensProjection
from .local_electrode import LocalElectrode as LocalElectrode
from .run_lens import RunLens as RunLens
from .run_lens import field_of_view as field_of_view
