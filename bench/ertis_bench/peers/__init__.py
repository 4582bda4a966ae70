"""The same image computed by other libraries, as their careful users would write it."""

from ertis_bench.peers.comparison import DIRECTIONS, PEERS, run
from ertis_bench.peers.table import peers

__all__ = ["DIRECTIONS", "FORMS", "PEERS", "run"]

FORMS = {"peers": peers}
