"""The same image computed by other libraries, as their careful users would write it."""

from ertis_bench.peers.comparison import DIRECTIONS, PEERS, run

__all__ = ["DIRECTIONS", "PEERS", "run"]
