"""How ions start: emissions, the frame along the surface, energy distributions, perturbations, random numbers."""
