"""Kernels of the GPU, compiled without one. Run by themselves: a process either compiles kernels or simulates them."""
