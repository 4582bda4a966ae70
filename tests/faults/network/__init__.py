"""Trials of a network of sensor nodes, a central node and applications."""
