"""Tests of the room passive."""
