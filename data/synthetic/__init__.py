"""Scenes, and the recordings that ``ertis example`` simulates from them."""
