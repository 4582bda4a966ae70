"""Scenes and the recordings simulated from them; ``ertis example`` copies them."""
