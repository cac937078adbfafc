"""Fits of emission energies to a measured map; settings, constants and patterns from measurements and runs."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
