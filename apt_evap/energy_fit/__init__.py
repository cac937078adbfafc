"""Fit of the emission energies to a measured map."""
