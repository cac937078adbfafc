"""Registration of two detector maps: rotation, scale, shift and mirror."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
