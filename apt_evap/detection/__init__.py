"""Detection of the ions: detector, hits, detector maps, mass ranges, projections."""
