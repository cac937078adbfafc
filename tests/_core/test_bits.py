"""The hot sums have the same bits on every processor: compiled for three of them, with three levels of optimisation."""

import os
import shutil
import subprocess
from pathlib import Path

import pytest

CORE = Path(__file__).parents[2] / "apt_evap" / "_core"
PROGRAM = r"""
#include "kernels.h"
#include <stdio.h>
#include <stdlib.h>
static unsigned long long hash = 1469598103934665603ULL;
static void add(const void *p, long n)
{
    for (long i = 0; i < n; i++)
        hash = (hash ^ ((const unsigned char *)p)[i]) * 1099511628211ULL;
}
int main(void)
{
    enum { N = 640 };
    static double x[N], y[N], z[N], q[N], cells[CELL * N];
    static float fx[N], fy[N], fz[N], fq[N], row[N], px[N], py[N], pz[N];
    static int list[N];
    int range[2] = {0, N};
    static float columns[CELL * N], square[100 * N];
    float targets[3 * GROUP], sums[3 * GROUP] = {0}, bundle[3 * GROUP] = {0}, lanes[303], dot;
    double wide[3 * GROUP], wide_sums[3 * GROUP] = {0}, totals[100], step[302];
    static double multipoles[MULTIPOLE * N];
    static float row_potential[N], zero[GROUP], cubes[N], change[N], inner[6][N];
    double potentials[GROUP] = {0}, zeros[GROUP] = {0};
    static float sum[N], product[N];
    double origin[3] = {5, 5, 12}, e[3] = {0};
    srand48(7);
    for (int i = 0; i < N; i++) {
        fx[i] = x[i] = drand48() * 10, fy[i] = y[i] = drand48() * 10, fz[i] = z[i] = drand48() * 10;
        q[i] = drand48(), fq[i] = q[i] - 0.5, list[i] = i;
        for (int j = 0; j < CELL; j++)
            columns[CELL * i + j] = cells[CELL * i + j] = drand48();
    }
    for (int l = 0; l < 3 * GROUP; l++)
        wide[l] = targets[l] = drand48();
    group_atoms_single(1, range, x, y, z, q, origin, targets, sums);
    group_cells_single(N, list, cells, origin, targets, sums);
    group_atoms_double(1, range, x, y, z, q, origin, wide, wide_sums);
    group_cells_double(N, list, cells, origin, wide, wide_sums);
    point_atoms_double(N - 3, x, y, z, q, 5, 5, 12, e);
    point_cells_double(N, N, cells, 5, 5, 12, e);
    bundle_atoms(N - 3, N, columns, GROUP, targets, bundle);
    bundle_cells(N - 3, N, columns, GROUP, targets, bundle);
    weighted_sum(99, N / 100, x, y, 100, totals);
    stage_places(101, 0.3, 0.7, x, y, z, step);
    enclosing_ball(101, x, y, z, 0.1, 0.3, step + 101);
    relative_lengths(101, 0.3, 0.1, x, y, z, step + 105);
    into_lanes(101, x, origin, lanes), out_of_lanes(96, 0.3, lanes, step + 206);
    add_polynomials(columns, targets, 0.3, GROUP, targets, bundle);
    group_charges_single(N, list, cells, q, origin, targets, sums);
    group_charges_double(N, list, cells, q, origin, wide, wide_sums);
    patch_column(N, fx, fy, fz, fy, fz, fx, 5, 5, 5, 0.1, row, cubes);
    for (int i = 0; i < 100 * N; i++)
        square[i] = 0.02 * (drand48() - 0.5);
    for (int i = 0; i < N; i++)
        sum[i] = drand48();
    row[1] = patch_iteration(100, N, square, sum, change);
    patch_field_of_cubes(CELL, N, columns, fx, fy, fz, fq, inner[0], inner[1], inner[2]);
    patch_field_of_inverse(CELL, N, columns, fx, fy, fz, fq, inner[3], inner[4], inner[5]);
    patch_product(CELL, N, columns, row, product);
    dot = patch_dot(N, row, fx);
    patch_field(N, fx, fy, fz, N - 1, fy, fz, fx, fq, px, py, pz);
    for (int i = 0; i < MULTIPOLE * N; i++)
        multipoles[i] = drand48();
    group_atoms_potential_single(1, range, x, y, z, q, origin, targets, zero, potentials);
    group_cells_potential_single(N, list, multipoles, origin, targets, zero, potentials);
    group_atoms_potential_double(1, range, x, y, z, q, origin, wide, zeros, potentials);
    group_cells_potential_double(N, list, multipoles, origin, wide, zeros, potentials);
    patch_row_potential(N, fx, fy, fz, 5, 5, 5, 15, row_potential);
    patch_potential(N, fx, fy, fz, N - 1, fy, fz, fx, fq, row_potential);
    patch_potential_and_field(N, fx, fy, fz, N - 1, fy, fz, fx, fq, row_potential, px, py, pz);
    add(potentials, sizeof potentials), add(row_potential, sizeof row_potential);
    add(sums, sizeof sums), add(wide_sums, sizeof wide_sums), add(e, sizeof e), add(row, sizeof row);
    add(sum, sizeof sum), add(product, sizeof product);
    add(cubes, sizeof cubes), add(change, sizeof change), add(inner, sizeof inner);
    add(bundle, sizeof bundle), add(totals, 99 * sizeof totals[0]);
    add(step, sizeof step), add(lanes, sizeof lanes);
    add(&dot, sizeof dot), add(px, sizeof px), add(py, sizeof py), add(pz, sizeof pz);
    printf("%016llx %g\n", hash, e[0]);
    return 0;
}
"""


@pytest.mark.slow  # compiles six times
def test_bits_do_not_depend_on_the_processor(tmp_path):
    compiler = shutil.which("gcc")
    if compiler is None:
        pytest.skip("needs gcc")
    # without clones each build has the one processor it is compiled for
    header = (
        (CORE / "kernels.h")
        .read_text()
        .replace("target_clones(", "unused)) /* target_clones(")
        .replace('"default"), unused))', '"default"), unused) */')
    )
    for part in CORE.glob("*.h"):
        (tmp_path / part.name).write_text(header if part.name == "kernels.h" else part.read_text())
    (tmp_path / "sums.c").write_text(PROGRAM)
    seen = {}
    flags = ["-fopenmp", "-fno-math-errno", "-fno-trapping-math", "-ffp-contract=off"]
    for processor in ("x86-64", "x86-64-v3", "x86-64-v4"):
        empty = [compiler, f"-march={processor}", "-fopenmp", "-E", "-x", "c", os.devnull]
        if subprocess.run(empty, capture_output=True).returncode:
            pytest.skip(f"gcc cannot build for {processor}")
        for level in ("-O1", "-O3"):
            build = [compiler, level, f"-march={processor}", *flags, "sums.c", "-o", "sums", "-lm"]
            built = subprocess.run(build, cwd=tmp_path, capture_output=True, text=True)
            assert built.returncode == 0, built.stderr
            done = subprocess.run(["./sums"], cwd=tmp_path, capture_output=True, text=True)
            if done.returncode == 0:  # else this processor lacks the instructions
                seen[processor, level] = done.stdout
    assert len(seen) >= 2
    assert len(set(seen.values())) == 1, seen
