"""Used only by compiled modules."""
