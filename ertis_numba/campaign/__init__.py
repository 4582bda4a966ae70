"""Campaigns: processing of many recordings to energyscapes or acoustic maps, on all cores or on a cluster.

Each recording becomes one output file, complete or not at all. An interrupted campaign therefore continues at the next
recording. Workers are independent processes: a crash affects only the recording in progress.

Names are imported when they are first used, because a worker needs only the modules that run its tasks.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
