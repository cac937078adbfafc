/* The hot sums: fields of point charges and of quadrupole cells; lengths in nm, charges in e, fields q r/r^3 in e/nm^2.
 *
 * Two ways round: `group_*` puts 32 targets into the vector lanes and goes through the sources one by one (a sweep),
 * `point_*` puts the sources into 8 lanes for one target (a flight). The lanes are fixed and nothing is contracted or
 * reassociated (-ffp-contract=off), so the bits are the same for SSE2, AVX2 and AVX-512.
 */
#ifndef APT_EVAP_PAIR_H
#define APT_EVAP_PAIR_H

#include <math.h>
#include <string.h>

/* musl and macOS have no ifunc: there the baseline of the build serves. */
#if defined(__GNUC__) && !defined(__clang__) && defined(__x86_64__) && defined(__GLIBC__)
#define APT_CLONES __attribute__((target_clones("arch=x86-64-v4", "arch=x86-64-v3", "default"), unused))
#elif defined(__GNUC__)
#define APT_CLONES __attribute__((unused))
#else
#define APT_CLONES
#endif

#define GROUP 32          /* targets of one group: two or four AVX-512 registers a coordinate */
#define CELL 10           /* numbers of one cell: centre x y z, charge, quadrupole xx xy xz yy yz zz */
#define LANES 8           /* sources of one point sum: an AVX-512 register of doubles */
#define SAME_PLACE 1e-12  /* [nm^2] below this a source is the target itself; atoms are 0.2 nm apart */

#define REAL float
#define REAL_SQRT sqrtf
#define GROUP_NAME(name) name##_single
#include "group.h"
#undef REAL
#undef REAL_SQRT
#undef GROUP_NAME
#define REAL double
#define REAL_SQRT sqrt
#define GROUP_NAME(name) name##_double
#include "group.h"
#undef REAL
#undef REAL_SQRT
#undef GROUP_NAME

/* Adds the field of n point charges at (px, py, pz) to field[3]. */
APT_CLONES static void point_atoms(long n, const double *restrict x, const double *restrict y, const double *restrict z,
                                   const double *restrict q, double px, double py, double pz, double *restrict field)
{
    double ex[LANES] = {0}, ey[LANES] = {0}, ez[LANES] = {0};
    for (long k = 0; k + LANES <= n; k += LANES) {
#pragma omp simd
        for (int l = 0; l < LANES; l++) {
            const double dx = px - x[k + l], dy = py - y[k + l], dz = pz - z[k + l];
            const double s = dx * dx + dy * dy + dz * dz;
            const double w = s > SAME_PLACE ? q[k + l] / (s * sqrt(s)) : 0.0;
            ex[l] += w * dx;
            ey[l] += w * dy;
            ez[l] += w * dz;
        }
    }
    for (long k = n - n % LANES; k < n; k++) {
        const double dx = px - x[k], dy = py - y[k], dz = pz - z[k];
        const double s = dx * dx + dy * dy + dz * dz;
        const double w = s > SAME_PLACE ? q[k] / (s * sqrt(s)) : 0.0;
        ex[k % LANES] += w * dx;
        ey[k % LANES] += w * dy;
        ez[k % LANES] += w * dz;
    }
    for (int l = 0; l < LANES; l++) {
        field[0] += ex[l];
        field[1] += ey[l];
        field[2] += ez[l];
    }
}

/* Adds the field of n cells at (px, py, pz) to field[3]; c holds CELL rows of `stride` numbers, n a multiple of LANES
 * (the caller fills up with cells of no charge). */
APT_CLONES static void point_cells(long n, long stride, const double *restrict c, double px, double py, double pz,
                                   double *restrict field)
{
    const double *restrict x = c, *restrict y = c + stride, *restrict z = c + 2 * stride, *restrict q = c + 3 * stride;
    const double *restrict xx = c + 4 * stride, *restrict xy = c + 5 * stride, *restrict xz = c + 6 * stride;
    const double *restrict yy = c + 7 * stride, *restrict yz = c + 8 * stride, *restrict zz = c + 9 * stride;
    double ex[LANES] = {0}, ey[LANES] = {0}, ez[LANES] = {0};
    for (long k = 0; k < n; k += LANES) {
#pragma omp simd
        for (int l = 0; l < LANES; l++) {
            const long j = k + l;
            const double dx = px - x[j], dy = py - y[j], dz = pz - z[j];
            const double w2 = 1.0 / (dx * dx + dy * dy + dz * dz);
            const double w3 = w2 * sqrt(w2), w5 = w3 * w2;
            const double gx = xx[j] * dx + xy[j] * dy + xz[j] * dz;
            const double gy = xy[j] * dx + yy[j] * dy + yz[j] * dz;
            const double gz = xz[j] * dx + yz[j] * dy + zz[j] * dz;
            const double radial = q[j] * w3 + 2.5 * w5 * w2 * (gx * dx + gy * dy + gz * dz);
            ex[l] += radial * dx - w5 * gx;
            ey[l] += radial * dy - w5 * gy;
            ez[l] += radial * dz - w5 * gz;
        }
    }
    for (int l = 0; l < LANES; l++) {
        field[0] += ex[l];
        field[1] += ey[l];
        field[2] += ez[l];
    }
}

/* One row of the Robin matrix: row[k] = n . (p - r_k)/|p - r_k|^3 for the atom at p with normal n. */
APT_CLONES static void robin_row(long n, const double *restrict x, const double *restrict y, const double *restrict z,
                                 const double *p, const double *normal, double *restrict row)
{
    const double px = p[0], py = p[1], pz = p[2], nx = normal[0], ny = normal[1], nz = normal[2];
#pragma omp simd
    for (long k = 0; k < n; k++) {
        const double dx = px - x[k], dy = py - y[k], dz = pz - z[k];
        const double s = dx * dx + dy * dy + dz * dz;
        row[k] = s > SAME_PLACE ? (nx * dx + ny * dy + nz * dz) / (s * sqrt(s)) : 0.0;
    }
}

/* Dot product in LANES fixed partial sums. */
APT_CLONES static double lane_dot(long n, const double *restrict a, const double *restrict b)
{
    double sum[LANES] = {0};
    for (long k = 0; k + LANES <= n; k += LANES) {
#pragma omp simd
        for (int l = 0; l < LANES; l++)
            sum[l] += a[k + l] * b[k + l];
    }
    for (long k = n - n % LANES; k < n; k++)
        sum[k % LANES] += a[k] * b[k];
    return ((sum[0] + sum[1]) + (sum[2] + sum[3])) + ((sum[4] + sum[5]) + (sum[6] + sum[7]));
}
#endif
