"""Benchmarks of the network: figures, faults, and the oracle that verifies them."""
