"""
2. Your own .epos
=================

Read a LEAP export, look at it, select ions, and draw its map without the stripes of the detector's comb.

``python tutorial_2_own_measurement.py R5083.epos`` takes a file of yours (.epos, .apt or .raw). Without one, a file is
made here first: ions on a comb of 0.027 mm, as a delay line detector gives them, a dark pole and dark zone lines among
them.
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
    kept = random.random(n) > dark
    comb = 0.02725, 0.02602
    x, y = (np.rint(radius * part(azimuth) / step) * step for part, step in zip((np.cos, np.sin), comb, strict=True))
    made = ae.Hits(
        x=x[kept],
        y=y[kept],
        positions=random.normal(size=(n, 3))[kept],
        mass_to_charge=random.choice([58.0, 60.0, 29.0], n, p=[0.6, 0.3, 0.1])[kept],
        time_of_flight=random.normal(600.0, 5.0, n)[kept],
        voltage=np.linspace(4000.0, 5000.0, n)[kept],
        pulse_id=np.cumsum(random.random(n) > 0.04)[kept],
    )
    ae.write(path, made)

# %%
# Whatever the format, the same columns come back, in the same units; what a file does not hold is None. Multi-hits
# are grouped when the file is read, before anything is selected.

measured = ae.read(path)
print(measured)
print("columns:", ", ".join(measured.columns))

# %%
# Ions are selected by masks, by windows of a column, or by a circle on the detector. With an .rrng file, ranges name
# the species: ``ae.read_ranges("R5083.rrng")``.

centre = [(column.min() + column.max()) / 2 for column in (measured.x, measured.y)]  # not at 0 in every file
late = measured.window(ion=(len(measured) // 2, None))  # measured ions are counted by their rows
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
# Bins that are no multiple of the comb's spacing hold now one tooth more, now one less, and show stripes (left). By
# default the spacing is found in the data and bins are multiples of it (right).

naive = measured.map(bins=256, quantum=None)
aware = measured.map(bins=256)
print(f"spacing of the comb: {aware.quantum} mm, bins of {aware.bin_size} mm")
ae.plot.detector_maps([naive, aware], ["bins of any size", "bins on the comb"])[0].figure.savefig("measured.png")

# %%
# How noisy is this map? Two random halves of the measurement are compared: 1 would be no noise at all. It is a scale to
# judge a simulation by, not its limit: a simulation has more ions than a half, and can come out higher.

for smoothing in (0.0, 0.5, 1.0):
    print(f"smoothed by {smoothing} mm:", ae.half_ceiling(measured, bins=128, smoothing=smoothing))
