"""Child processes of this package: start, typed messages, deadlines, restart, and their end with the parent."""

from ertis_numba.processes.child import Child, connect, is_child
from ertis_numba.processes.pipe import Pipe, anonymous_memory, wait_for
from ertis_numba.processes.supervised import SupervisedProcess

__all__ = ["Child", "Pipe", "SupervisedProcess", "anonymous_memory", "connect", "is_child", "wait_for"]
