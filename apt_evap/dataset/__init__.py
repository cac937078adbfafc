"""Data sets with the truth of every ion, for machine learning: made from a study file, and read again."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
