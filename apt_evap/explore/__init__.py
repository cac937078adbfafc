"""The explorer: maps of a run for any emission, compared with a measured map while a slider moves."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
