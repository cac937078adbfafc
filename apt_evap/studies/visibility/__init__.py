"""Probability that an analysis finds a feature, origin operators and their emulator, apparent short-range order."""
