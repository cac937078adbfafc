"""Names of imaging gases; no numerical module is imported, for the help of the shell."""

GASES = ("He", "Ne", "Ar", "H2")
"""Imaging gases of a field ion microscope."""
