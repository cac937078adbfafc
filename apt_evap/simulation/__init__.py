"""The simulation and its runs: monitoring, files and checkpoints."""
