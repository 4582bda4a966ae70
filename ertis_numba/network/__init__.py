"""Nodes that speak over the network: sensors send, a central node stores and processes, applications subscribe.

The only door to ZeroMQ.
"""
