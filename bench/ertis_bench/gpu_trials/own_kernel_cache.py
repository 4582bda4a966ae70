"""Plugin of pytest: each process of tests keeps compiled kernels in a folder of its own.

Processes that compile the same kernel at the same time could corrupt a common folder.
"""

import os
import tempfile

# Numba reads this variable when it is imported, which happens after pytest has loaded its plugins.
_FOLDER = tempfile.TemporaryDirectory(prefix="ertis-kernels-", ignore_cleanup_errors=True)
os.environ["NUMBA_CACHE_DIR"] = _FOLDER.name
