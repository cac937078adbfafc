"""Sweeps: many runs from one study file, shared by any number of processes."""
