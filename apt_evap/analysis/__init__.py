"""Measures of runs and their hits: charge states, the cap, field factors, tracks of single ions, field-ion images."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
