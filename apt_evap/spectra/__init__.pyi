# The public names of this package: read by type checkers, and by the lazy loader in __init__.py.
from .charge_states import charge_history as charge_history
from .charge_states import charge_state_ratio_history as charge_state_ratio_history
from .charge_states import charge_state_ratio_map as charge_state_ratio_map
from .composition import Composition as Composition
from .mass_ranges import Ranges as Ranges
from .mass_spectrum import Spectrum as Spectrum
