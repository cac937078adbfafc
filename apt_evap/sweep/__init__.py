"""Sweeps: many runs from one study file, by processes of one machine or of a cluster."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
