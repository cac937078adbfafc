"""The sums of a patch in ``kernels.h`` against plain NumPy: built for this test with the compiler of the core."""

import ctypes
import shutil
import subprocess
from pathlib import Path

import numpy as np
import pytest
import twins

CORE = Path(__file__).parents[2] / "apt_evap" / "_core"
LIBRARY = """
#include "kernels.h"
void column(Index n, float *r, float *normal, Index i, float factor, float *column, float *cubes)
{
    patch_column(n, r, r + n, r + 2 * n, normal, normal + n, normal + 2 * n, r[i], r[n + i], r[2 * n + i], factor,
                 column, cubes);
}
void inverse(Index n, float *r, Index i, float self, float *row)
{
    patch_row_potential(n, r, r + n, r + 2 * n, r[i], r[n + i], r[2 * n + i], self, row);
}
float iteration(Index n, Index stride, float *columns, float *right, float *change)
{
    return patch_iteration(n, stride, columns, right, change);
}
void of_cubes(Index n, Index m, float *rows, float *r, float *q, float *e)
{
    patch_field_of_cubes(n, m, rows, r, r + m, r + 2 * m, q, e, e + m, e + 2 * m);
}
void of_inverse(Index n, Index m, float *rows, float *r, float *q, float *e)
{
    patch_field_of_inverse(n, m, rows, r, r + m, r + 2 * m, q, e, e + m, e + 2 * m);
}
"""
N, STRIDE = 150, 192  # two complete blocks of 64 atoms, and a part of a third one


@pytest.fixture(scope="session")
def sums(tmp_path_factory):
    """The library, as a function of its function's name and arguments."""
    compiler, folder = shutil.which("gcc"), tmp_path_factory.mktemp("sums")
    if compiler is None:
        pytest.skip("needs gcc")
    (folder / "sums.c").write_text(LIBRARY)
    flags = ["-O3", "-fopenmp-simd", "-fno-math-errno", "-fno-trapping-math", "-ffp-contract=off", "-shared", "-fPIC"]
    library = str(folder / "sums.so")
    subprocess.run([compiler, *flags, f"-I{CORE}", "sums.c", "-o", library, "-lm"], cwd=folder, check=True)
    loaded = ctypes.CDLL(library)
    loaded.iteration.restype = ctypes.c_float

    def call(name, *arguments):
        kinds = {int: ctypes.c_longlong, float: ctypes.c_float}
        plain = (kinds[type(a)](a) if type(a) in kinds else a.ctypes.data_as(ctypes.c_void_p) for a in arguments)
        return getattr(loaded, name)(*plain)

    return call


@pytest.fixture
def patch(rng):
    """Positions (3, STRIDE) [nm] of atoms on a rough plane, 0.25 nm apart, padded far away; changes of either sign."""
    k = np.arange(N)
    places = np.full((3, STRIDE), 1e6, np.float32)
    places[:, :N] = 0.25 * np.array([k % 12 - 6, k // 12 - 6, rng.integers(0, 2, N)]) + rng.normal(0, 0.01, (3, N))
    changes = np.zeros(STRIDE, np.float32)
    changes[:N] = rng.normal(size=N)
    return places, changes


def test_fields_from_the_matrix(sums, patch):
    """1/r^3 and 1/r of the matrix give the field of the changes at their own atoms; the diagonal does not act."""
    places, changes = patch
    cubes, inverse, column = np.empty((3, N, STRIDE), np.float32)
    normals = np.zeros((3, STRIDE), np.float32)
    normals[2] = 1.0
    for i in range(N):
        sums("column", STRIDE, places, normals, i, 0.5, column[i], cubes[i])
        sums("inverse", STRIDE, places, i, 16.0, inverse[i])
    atoms = places[:, :N].T.astype(np.float64)
    expected = twins.field(atoms, atoms, changes[:N].astype(np.float64))
    scale = np.sqrt((expected**2).mean())
    for name, rows in (("of_cubes", cubes), ("of_inverse", inverse)):
        field = np.empty((3, STRIDE), np.float32)
        sums(name, N, STRIDE, rows, places, changes, field)
        # 150 terms in float32, 6e-8 each; of differences of places up to 6 times the distance of neighbours
        assert np.abs(field[:, :N].T - expected).max() < 2e-5 * scale, name
    # the column of an atom: half of the field of a unit charge there along the normals
    one = np.zeros(N)
    one[7] = 1.0
    assert column[7, :N] == pytest.approx(0.5 * twins.field(atoms, atoms, one)[:, 2], abs=1e-4)


def test_two_charges(sums):
    """Charges 2 and -1, 0.5 nm apart: fields 1/r^2 of the other one, which are 4 and 8 per nm^2, along the line."""
    places = np.full((3, 64), 1e6, np.float32)
    places[:, :2] = [[0.0, 0.5], [0.0, 0.0], [0.0, 0.0]]
    changes = np.zeros(64, np.float32)
    changes[:2] = 2.0, -1.0
    for name, power in (("of_cubes", 3), ("of_inverse", 1)):
        rows = np.zeros((2, 64), np.float32)
        rows[0, 1] = rows[1, 0] = 2.0**power
        field = np.empty((3, 64), np.float32)
        sums(name, 2, 64, rows, places, changes, field)
        assert field[:, :2].tolist() == [[4.0, 8.0], [0.0, 0.0], [0.0, 0.0]], name


def test_an_iteration_is_that_of_gauss_and_seidel(sums, rng):
    """Each change becomes its right side in turn, and acts on all right sides: by blocks the same bits."""
    columns = (rng.normal(size=(N, STRIDE)) / N).astype(np.float32)
    right = rng.normal(size=STRIDE).astype(np.float32)
    change = np.zeros(STRIDE, np.float32)
    slow, slow_change = right.copy(), change.copy()
    for _ in range(3):
        largest = np.float32(0.0)
        for i in range(N):
            step = slow[i] - slow_change[i]
            largest, slow_change[i] = max(largest, abs(step)), slow[i]
            slow += step * columns[i]
        assert sums("iteration", N, STRIDE, columns, right, change) == largest
        assert (right == slow).all() and (change == slow_change).all()


def test_the_iteration_solves_the_equations(sums, rng):
    """At its end x = r + A x, by a direct solution."""
    columns = (rng.normal(size=(N, STRIDE)) / (4 * N)).astype(np.float32)
    start = rng.normal(size=STRIDE).astype(np.float32)
    right, change = start.copy(), np.zeros(STRIDE, np.float32)
    for _ in range(20):
        step = sums("iteration", N, STRIDE, columns, right, change)
    exact = np.linalg.solve(np.eye(N) - columns[:, :N].T.astype(np.float64), start[:N].astype(np.float64))
    assert step < 1e-5
    assert change[:N] == pytest.approx(exact, abs=1e-5)
