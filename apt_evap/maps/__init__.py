"""Measures of detector maps: profiles, rings about a pole, zone lines, similarity; they need no run."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
