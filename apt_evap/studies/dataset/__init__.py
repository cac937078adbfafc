"""Data sets for machine learning: examples from the runs of a sweep, their files, their reading."""
