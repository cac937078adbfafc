"""Positions of the ions in the specimen from their hits, calibration, and errors against the true sites."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
