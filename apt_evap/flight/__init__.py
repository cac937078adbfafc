"""Flights of the ions to the detector, and the response of each ion to its launch velocity."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
