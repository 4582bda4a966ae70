"""Campaign of the health checks: healthy arrays of all kinds, and every kind of fault."""

from ertis_bench.health.campaign import run

__all__ = ["run"]
