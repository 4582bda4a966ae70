"""Central node: receives measurements from sensor nodes, stores them and passes them to processing."""

from ertis_numba.network.central_node._archive import Archive
from ertis_numba.network.central_node._node import CentralNode

__all__ = ["Archive", "CentralNode"]
