"""Compiled modules alone use it."""
