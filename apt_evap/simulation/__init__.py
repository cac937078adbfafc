"""The simulation and its runs: flights and responses, files, real units, the apex, tracks, field-ion images."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
