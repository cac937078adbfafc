"""Detection of the ions: detector, hits, detector maps, projections, the lens of an instrument."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
