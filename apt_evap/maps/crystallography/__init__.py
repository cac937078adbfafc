"""Poles and zone lines, orientation of a specimen, symmetry about its axis."""
