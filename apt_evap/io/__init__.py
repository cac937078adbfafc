"""File formats of ions: one module per format; `formats` lists them and contains `read`, `write` and `chunks`."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
