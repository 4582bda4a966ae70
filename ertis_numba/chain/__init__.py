"""Stages of the signal chain. Each stage computes its tables once; after that, it only calls kernels."""
