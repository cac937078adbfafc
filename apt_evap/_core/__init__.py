"""The compiled core: arrays in, arrays out; it knows positions, species and charges, no lattice and no material."""
