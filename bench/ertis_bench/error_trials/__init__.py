"""Trials with random settings, arrays and points: error budgets, uncertainties, calibration and ``--verify``."""
