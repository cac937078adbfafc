"""Reports: a study or a sweep as one HTML file that needs no network."""

import lazy_loader

# matplotlib is imported with the first report
__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
