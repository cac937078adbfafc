"""Fit of the emission energies to a measured map; settings of a simulation and constants from a measurement."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
