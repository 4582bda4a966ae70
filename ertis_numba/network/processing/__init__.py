"""Image processing: worker processes make images of measurements, and a publisher sends them to applications."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
