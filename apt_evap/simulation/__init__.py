"""The simulation, its runs, their monitoring, files and checkpoints."""
