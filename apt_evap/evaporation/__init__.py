"""The charged surface and the sequence of evaporation: settings, rules, laws, the emitter and its state."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
