"""Storage: HDF5 files with checksums, the groups that NeXus requires of them, and locks."""
