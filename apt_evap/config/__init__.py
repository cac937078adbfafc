"""Settings files of simulations, map panels and perturbations written as text."""
