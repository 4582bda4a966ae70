"""Tests of the room mapping."""
