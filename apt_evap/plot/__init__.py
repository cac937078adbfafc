"""Plots: functions that draw into axes and return them, with or without pyplot."""

import lazy_loader

# matplotlib is imported with the first plot
__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
