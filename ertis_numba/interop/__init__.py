"""Readers and writers of foreign formats.

Names are imported when they are first used, because most need libraries that others do not.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
