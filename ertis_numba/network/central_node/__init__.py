"""The central node: takes what sensor nodes send, stores it, and hands it on to processing."""

from ertis_numba.network.central_node._archive import Archive
from ertis_numba.network.central_node._node import CentralNode

__all__ = ["Archive", "CentralNode"]
