"""Mass spectra: ranges, isotopes, the ions that explain the peaks, the flight length, ratios of charge states."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
