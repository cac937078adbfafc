"""Where ions are recorded: the detector, hits, detector maps, mass ranges, projections."""
