"""Which crystal direction is where on a measured map: master patterns, the search, and what the map decides."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
