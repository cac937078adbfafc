# The public names of this package: read by type checkers, and by the lazy loader in __init__.py.
from .bonds import TUNGSTEN_TABLE as TUNGSTEN_TABLE
from .bonds import CoordinationTable as CoordinationTable
from .bonds import PairEnergies as PairEnergies
from .charge_settings import ChargeSettings as ChargeSettings
from .emitter import Emitter as Emitter
from .law import Law as Law
from .losses import conditions as conditions
from .rule import Rule as Rule
from .thermal import Laser as Laser
from .voltage import VoltageControl as VoltageControl
