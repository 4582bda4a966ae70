"""Benchmark of the latency of the network, and its processes, which other benchmarks and trials share."""
