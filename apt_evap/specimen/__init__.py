"""The specimen: crystals, materials, alloys, the shape of a tip and the shell of atoms near its surface."""
