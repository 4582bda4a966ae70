"""Tests of the room ros."""
