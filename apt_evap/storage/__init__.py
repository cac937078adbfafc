"""Storage: HDF5 files with a digest of all bytes, and the groups that NeXus requires of them."""
