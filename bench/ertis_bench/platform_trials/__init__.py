"""Trials of fusion, motion and maps of moving platforms with several sensors."""
