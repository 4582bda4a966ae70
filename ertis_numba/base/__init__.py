"""Errors, checks, units, angles and files, which every part uses; imports nothing of the package."""
