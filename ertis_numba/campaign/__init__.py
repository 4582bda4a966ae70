"""Campaigns: processing of many recordings to energyscapes or acoustic maps, on all cores or on a cluster.

Each recording becomes one output file, complete or not at all; a crash of a worker affects only one recording.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
