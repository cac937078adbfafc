"""Field evaporation in atom probe tomography: Robin-Rolland electrostatics with stochastic ion emission."""

import lazy_loader

from apt_evap._common.notebook import shown_by as _shown_by
from apt_evap._common.version import __version__ as __version__

# names are imported when they are first used (SPEC 1 of Scientific Python): the list is __init__.pyi
__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
__all__ += ["__version__"]
_shown_by("apt_evap.plot.report.notebook_views")
