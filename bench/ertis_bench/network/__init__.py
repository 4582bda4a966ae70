"""Benchmark of the network, and the oracle that verifies it."""
