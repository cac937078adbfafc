"""Compiled core: arrays in, arrays out; it uses positions and charges, without lattices or materials."""
