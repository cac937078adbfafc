"""Bounds of the parameters of maps, in a module without imports, so that the shell can check them quickly."""

MAX_BINS = 16384
"""Largest number of bins along a side: 2 GB of counts."""
