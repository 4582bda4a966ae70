"""Tests of the room sensor_check."""
