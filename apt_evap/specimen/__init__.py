"""The specimen: crystals, materials, alloys, the shape of a tip and the shell of atoms near its surface."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
