"""Studies and sweeps as one HTML file, and views of objects in notebooks."""
