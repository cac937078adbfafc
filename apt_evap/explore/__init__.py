"""The explorer: maps of a run for any emission, compared with a measured map while a slider moves."""
