"""Validation of user input, files, memory, threads and types, shared by all packages."""
