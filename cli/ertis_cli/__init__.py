"""The command line of ertis-numba."""
