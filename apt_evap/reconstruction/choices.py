"""Words that select a protocol and a projection; no numerical module is imported, for the help of the shell."""

PROTOCOLS = ("cap", "bas")
"""Depth increments: of the spherical cap, exact; with the area of the detector, of Bas et al."""

PROJECTIONS = ("bas", "equidistant", "compressed")
"""Relations between the distance on the detector and the angle on the cap."""

FRAMES = ("depth", "specimen")
"""Direction of z: the depth, or out of the specimen."""
