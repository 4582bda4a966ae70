# Public names; __init__.py imports each of them at its first use.

from .options import ProcessingOptions as ProcessingOptions
from .processing import ImageProcessing as ImageProcessing
from .queues import ProcessingCounts as ProcessingCounts
