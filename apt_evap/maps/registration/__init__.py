"""The transform between two maps, the search for it, and whether both show the same crystal."""
