"""The charged surface and the sequence of evaporation: settings, rules, laws, the emitter and its state."""
