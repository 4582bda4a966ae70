"""The stages of the signal chain: each prepares its tables once and then only calls kernels."""
