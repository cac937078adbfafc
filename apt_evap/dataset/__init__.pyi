# The public names of this room: read by type checkers, and by the lazy loader in __init__.py.
from .description import verify as verify
from .fields import TABLES as TABLES
from .fields import Field as Field
from .loading import DataSet as DataSet
from .loading import Example as Example
from .loading import load as load
from .making import PlannedSet as PlannedSet
from .making import make as make
from .making import plan_set as plan_set
from .settings import SPLITS as SPLITS
from .settings import DatasetSettings as DatasetSettings
