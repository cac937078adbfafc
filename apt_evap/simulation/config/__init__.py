"""Settings files of simulations, map panels, and perturbations as text."""
