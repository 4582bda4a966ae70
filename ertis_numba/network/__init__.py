"""Network nodes: sensor nodes send, a central node stores and processes, applications subscribe.

This package is the only one that imports ZeroMQ.
"""
