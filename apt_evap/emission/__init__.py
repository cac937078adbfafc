"""Start of the ions: emissions, the tangent frame, energy distributions, perturbations, random numbers."""
