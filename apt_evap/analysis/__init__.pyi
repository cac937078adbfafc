# The public names of this package: read by type checkers, and by the lazy loader in __init__.py.
from .apex import fit_caps as fit_caps
from .apex import image_compression as image_compression
from .charge_states import charge_history as charge_history
from .charge_states import charge_state_ratio_history as charge_state_ratio_history
from .charge_states import charge_state_ratio_map as charge_state_ratio_map
from .ion_image import ImagingGas as ImagingGas
from .ion_image import field_ion_image as field_ion_image
from .pattern_of_runs import master_pattern as master_pattern
from .response_tracks import lateral_tracks as lateral_tracks
from .response_tracks import rollup_tracks as rollup_tracks
