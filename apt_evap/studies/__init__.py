"""Sweeps of many runs, data sets for machine learning, and the probability that an analysis finds a feature."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
