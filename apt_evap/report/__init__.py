"""Reports: a study or a sweep as one HTML file that needs no network.

Examples
--------
>>> run = ae.Simulation(ae.Tip("Ni", apex_radius=2.5, axis=(1, 1, 1)), seed=1).run(400)
>>> measured = run.hits(ae.RollUp(0.2)).map(bins=16, extent=(-60, 60, -60, 60))
>>> identity = ae.Registration(rotation=0.0, scale=1.0, shift=(0.0, 0.0))
>>> settings = ae.fit.EnergyGrid("roll-up", means=(0.1, 0.2, 0.3)), ae.fit.FitSettings(resamples=0)
>>> study = ae.fit_energies(run, measured, *settings, registration=identity)
>>> ae.report.write_study(study, "study.html")
>>> sorted(ae.report.read("study.html"))
['origin', 'study']
"""

import lazy_loader

# matplotlib is imported with the first report
__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
