"""Benchmarks of the processing chain, the network and the files, run by ``ertis bench``."""
