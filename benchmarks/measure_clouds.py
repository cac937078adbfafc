"""Processor time and memory of the measures of point clouds: ``python benchmarks/measure_clouds.py 100000``.

Ions at 50 per nm^3 in a cube, with 1 % copper, and balls of radius 1.5 nm with 50 %, one in 1000 nm^3. Each measure
runs once; the memory is the largest of the process so far, and the first line is that of the ions alone.
"""

import resource
import sys
import time

import numpy as np
import scipy

import apt_evap as ae


def cloud_of(ions):
    rng = np.random.default_rng(1)
    size = (ions / 50) ** (1 / 3)
    positions = size * rng.random((ions, 3))
    number = max(1, round(size / 10))
    places = (np.arange(number) + 0.5) * size / number
    centres = np.stack(np.meshgrid(places, places, places), axis=-1).reshape(-1, 3)
    inside = scipy.spatial.cKDTree(centres).query(positions, distance_upper_bound=1.5)[0] < 1.5
    copper = rng.random(ions) < np.where(inside, 0.5, 0.01)
    return ae.measures.PointCloud(positions, copper.astype(int), ["Al", "Cu"]), number**3


def report(name, start, result=""):
    memory = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e6
    print(f"{name:28} {time.process_time() - start:8.2f} s {memory:6.2f} GB  {result}", flush=True)


def main():
    start = time.process_time()
    cloud, balls = cloud_of(int(sys.argv[1]))
    report("ions", start, f"{len(cloud):,} ions, {cloud.mark('Cu').sum():,} solutes, {balls} balls")
    clusters = []
    for name, measure in (
        ("clusters, d_max 0.45 nm", lambda: len(cloud.clusters("Cu", 0.45, 20))),
        ("clusters, d_max chosen", lambda: clusters.append(cloud.clusters("Cu")) or len(clusters[-1])),
        ("their compositions", lambda: f"{clusters[-1].fractions()['Cu'].value:.3f} of 0.5"),
        ("field, voxels of 0.5 nm", lambda: f"{cloud.field('Cu').fraction.size:,} voxels"),
        ("proxigram, reach 1 nm", lambda: f"{cloud.proxigram('Cu', 0.25, reach=1.0).atoms.sum():,.0f} atoms"),
        ("short-range order, 0.3 nm", lambda: f"{cloud.short_range_order(0.3).parameters[1, 1]:.3f}"),
        ("g(r) of Cu to 2 nm", lambda: f"{cloud.radial_distribution('Cu', 'Cu').g[-1]:.2f}"),
    ):
        start = time.process_time()
        result = measure()
        report(name, start, result)


if __name__ == "__main__":
    main()
