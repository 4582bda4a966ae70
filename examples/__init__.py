"""Scenes and scripts to start from; ``ertis example`` copies them."""
