"""Ceilings and times of devices, for benchmarks of the repository; the wheel does not contain this package."""
