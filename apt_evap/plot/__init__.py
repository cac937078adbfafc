"""Plots: functions that draw into axes and return them, with or without pyplot.

Examples
--------
>>> run = ae.Simulation(ae.Tip("Ni", apex_radius=2.0, axis=(1, 1, 1)), seed=1).run(100)
>>> axes = ae.plot.detector_map(run.hits(ae.RollUp(0.2)).map(bins=30).smoothed(10.0))
>>> axes.figure.savefig("rolled.png")
>>> axes.get_xlabel()
'x [mm]'
"""

import lazy_loader

# matplotlib is imported with the first plot
__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
