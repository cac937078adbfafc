"""Whether a feature of a specimen is visible, and the order that evaporation alone feigns."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
