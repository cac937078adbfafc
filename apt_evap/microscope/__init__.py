"""The microscope around a specimen: the lens that specimen, shank and electrode form."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
