"""Start of the ions: emissions, the tangent frame, energy distributions, perturbations, random numbers."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
