"""Settings with changed accuracy, and the chain that processes signals before modulation."""

from ertis_numba import kernels
from ertis_numba.chain.fast_chain import FastChain
from ertis_numba.pipeline import Pipeline


def tuned(settings, **changes):
    """Settings with some of their accuracy changed."""
    return settings.replace(accuracy=settings.accuracy.replace(**changes))


def chain_of(settings):
    """A single-threaded chain, which can also process signals before modulation."""
    return FastChain(Pipeline(settings, threads=1).settings, kernels.load("cpu"), threads=1)
