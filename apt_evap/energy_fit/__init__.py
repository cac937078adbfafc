"""The emission energies that fit a measured map."""
