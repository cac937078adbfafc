"""Workflows: what the commands `run`, `compare` and `twin` do, as functions."""
