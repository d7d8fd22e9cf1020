"""Timings of hypogoal against what it replaces; not installed with the package."""
