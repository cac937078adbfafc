"""
2. Your own measurement
=======================

Read a LEAP export, select ions, and draw a detector map without quantisation stripes.

``python tutorial_2_own_measurement.py R5083.epos`` reads your file (.epos, .apt or .raw). Without an argument, the
script creates an example file. Its coordinates have a quantisation step of 0.027 mm, like those of a delay line
detector, and its map has a dark pole and dark zone lines.
"""

import sys

import numpy as np

import apt_evap as ae

path = sys.argv[1] if len(sys.argv) > 1 and sys.argv[1].endswith((".epos", ".apt", ".raw")) else None
if path is None:
    path = "measured.epos"
    random = np.random.default_rng(5)
    n = 400_000
    radius, azimuth = 18.0 * np.sqrt(random.random(n)), 2 * np.pi * random.random(n)
    dark = 0.5 * np.exp(-((radius / 1.5) ** 2)) + 0.3 * np.exp(-((radius * np.sin(1.5 * azimuth) / 0.8) ** 2))
    mask = random.random(n) > dark
    steps = 0.02725, 0.02602  # quantisation steps in x and y [mm]
    x, y = (np.rint(radius * part(azimuth) / step) * step for part, step in zip((np.cos, np.sin), steps, strict=True))
    example = ae.Hits(
        x=x[mask],
        y=y[mask],
        positions=random.normal(size=(n, 3))[mask],
        mass_to_charge=random.choice([58.0, 60.0, 29.0], n, p=[0.6, 0.3, 0.1])[mask],
        time_of_flight=random.normal(600.0, 5.0, n)[mask],
        voltage=np.linspace(4000.0, 5000.0, n)[mask],
        pulse_id=np.cumsum(random.random(n) > 0.04)[mask],
    )
    ae.write(path, example)

# %%
# All formats give the same columns in the same units. Columns that the file does not contain are None. Multiple hits
# are grouped when the file is read, before any selection.

measured = ae.read(path)
print(measured)
print("columns:", ", ".join(measured.columns))

# %%
# Ions are selected by masks, by windows of a column, or by a circle on the detector. An .rrng file assigns species to
# mass ranges: ``ae.io.read_ranges("R5083.rrng")``.

centre = [(column.min() + column.max()) / 2 for column in (measured.x, measured.y)]  # not (0, 0) in every file
late = measured.window(ion=(len(measured) // 2, None))  # measured ions are numbered by row
inner = late.within_circle(10.0, centre=centre)
print(f"{len(late):,} ions in the second half, {len(inner):,} of them within 10 mm of {np.round(centre, 1)} mm")
if measured.mass_to_charge is not None:
    counts, edges = np.histogram(measured.mass_to_charge, np.arange(0.0, 200.0, 0.5))
    peak = edges[counts.argmax()], edges[counts.argmax() + 1]
    print(f"{len(measured.window(mass_to_charge=peak)):,} ions in the highest peak, {peak[0]} to {peak[1]} Da")
if measured.voltage is not None:
    print(f"{len(measured.window(voltage=(4500.0, None))):,} ions above 4.5 kV")
if measured.multiplicity is not None:
    print(f"{len(measured[measured.multiplicity == 1]):,} ions alone in a pulse")

# %%
# Measured coordinates are quantised. Bins that are not multiples of the quantisation step alias into stripes (left). By
# default, the step is determined from the data, and the bins are multiples of it (right).

arbitrary = measured.map(bins=256, position_step=None)
aligned = measured.map(bins=256)
print(f"quantisation step: {aligned.position_step} mm, bin size: {aligned.bin_size} mm")
axes = ae.plot.detector_maps([arbitrary, aligned], ["arbitrary bins", "multiples of the step"])
axes[0].figure.savefig("measured.png")

# %%
# To estimate the noise of the map, two random halves of the measurement are compared. Without noise, their similarity
# would be 1. This value is a reference for the comparison with a simulation, but not an upper limit: a simulation can
# have more ions than one half, and therefore a higher similarity.

for smoothing in (0.0, 0.5, 1.0):
    print(f"smoothed by {smoothing} mm:", ae.maps.similarity_ceiling(measured, bins=128, smoothing=smoothing))
