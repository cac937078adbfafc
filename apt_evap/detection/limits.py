"""Bounds of what a map may be asked for; numbers alone, which the shell checks before anything is loaded."""

MAX_BINS = 16384
"""Bins along a side: 2 GB of counts."""
