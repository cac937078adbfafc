"""The charged surface and the sequence of atoms that leave it: settings, laws, the emitter and its state."""
