"""Detector maps: profiles, rings about a pole, zone lines, similarity, orientation, registration, indexing."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
