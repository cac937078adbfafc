# The public names of this package: read by type checkers, and by the lazy loader in __init__.py.
from .apex import fit_caps as fit_caps
from .apex import image_compression as image_compression
from .checkpoint import Checkpoint as Checkpoint
from .flight.flight_pool import FlightSettings as FlightSettings
from .flight.launch_designs import Design as Design
from .ion_image import ImagingGas as ImagingGas
from .ion_image import field_ion_image as field_ion_image
from .monitor import Monitor as Monitor
from .real_units import OperatingPoint as OperatingPoint
from .recorder import RunInterrupted as RunInterrupted
from .recorder import RunNotSaved as RunNotSaved
from .response_tracks import lateral_tracks as lateral_tracks
from .response_tracks import rollup_tracks as rollup_tracks
from .surface import surface_after as surface_after
