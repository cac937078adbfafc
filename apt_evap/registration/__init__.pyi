# The public names of this room: read by type checkers, and by the lazy loader in __init__.py.
from .polynomial import Distortion as Distortion
from .register import ScoreSurface as ScoreSurface
from .register import register_distortion as register_distortion
from .register import register_points as register_points
from .register import score_surface as score_surface
from .transform import SimilarityTransform as SimilarityTransform
from .verdict import Likeness as Likeness
from .verdict import likeness as likeness
