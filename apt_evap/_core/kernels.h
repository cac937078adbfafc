/* The hot sums: fields of point charges and of quadrupole cells; lengths in nm, charges in e, fields q r/r^3 in e/nm^2.
 *
 * Three layouts: `group_*` has 32 targets in the vector lanes and loops over the sources (a sweep),
 * `point_*` has the sources in 8 lanes for one target (a field at a point), or in 16 lanes of single precision (a
 * flight); `bundle_*` has 16 targets in the lanes (the flights of a group). The lanes are fixed and nothing is contracted
 * or reassociated (-ffp-contract=off), so the bits are the same for SSE2, AVX2 and AVX-512.
 */
#ifndef APT_EVAP_PAIR_H
#define APT_EVAP_PAIR_H

#include <math.h>
#include <string.h>

#include "index.h"

/* musl and macOS have no ifunc, and GCC before 12 does not know these levels: then the baseline of the build applies. */
#if defined(__GNUC__) && !defined(__clang__) && __GNUC__ >= 12 && defined(__x86_64__) && defined(__GLIBC__)
#define APT_CLONES __attribute__((target_clones("arch=x86-64-v4", "arch=x86-64-v3", "default"), unused))
#elif defined(__GNUC__)
#define APT_CLONES __attribute__((unused))
#else
#define APT_CLONES
#endif

#define GROUP 32          /* targets of one group: two or four AVX-512 registers per coordinate */
#define CELL 10           /* numbers of one cell: centre x y z, charge, quadrupole xx xy xz yy yz zz */
#define MULTIPOLE 23      /* numbers of one cell of potentials: centre, charge, dipole, quadrupole, octupole */
#define CHUNK 64          /* sources of a partial sum of potentials */
#define LANES 8           /* sources of one point sum: an AVX-512 register of doubles */
#define SINGLE_LANES 16   /* the same in single precision */
#define SAME_PLACE 1e-12  /* [nm^2] below this a source is the target itself; atoms are 0.2 nm apart */

#define REAL float
#define REAL_SQRT sqrtf
#define GROUP_NAME(name) name##_single
#include "kernels_group.h"
#undef REAL
#undef REAL_SQRT
#undef GROUP_NAME
#define REAL double
#define REAL_SQRT sqrt
#define GROUP_NAME(name) name##_double
#include "kernels_group.h"
#undef REAL
#undef REAL_SQRT
#undef GROUP_NAME

#define REAL float
#define REAL_SQRT sqrtf
#define POINT_LANES SINGLE_LANES
#define POINT_NAME(name) name##_single
#include "kernels_point.h"
#undef REAL
#undef REAL_SQRT
#undef POINT_LANES
#undef POINT_NAME
#define REAL double
#define REAL_SQRT sqrt
#define POINT_LANES LANES
#define POINT_NAME(name) name##_double
#include "kernels_point.h"
#undef REAL
#undef REAL_SQRT
#undef POINT_LANES
#undef POINT_NAME

#include "kernels_bundle.h"

/* Adds three polynomials at m places, a multiple of SINGLE_LANES: targets and field contain x[m], y[m], z[m]. With
 * u = scale (x - centre), the polynomials are sums of coefficients of all u^i v^j w^k with i + j + k <= DEGREE (k fastest),
 * for each component in turn. Horner's scheme in each variable; without loops that depend on i and j it takes 0.28 of
 * the time, so the degree is fixed. */
#define DEGREE 5
APT_CLONES static void add_polynomials(const float *restrict coefficients, const float *restrict centre, float scale,
                                       Index m, const float *restrict targets, float *restrict field)
{
    const int stride = (DEGREE + 1) * (DEGREE + 2) * (DEGREE + 3) / 6;
    for (Index first = 0; first < m; first += SINGLE_LANES) {
        float x[SINGLE_LANES], y[SINGLE_LANES], z[SINGLE_LANES];
#pragma omp simd
        for (int l = 0; l < SINGLE_LANES; l++) {
            x[l] = scale * (targets[first + l] - centre[0]);
            y[l] = scale * (targets[m + first + l] - centre[1]);
            z[l] = scale * (targets[2 * m + first + l] - centre[2]);
        }
        for (int axis = 0; axis < 3; axis++) {
            const float *restrict component = coefficients + axis * stride;
#pragma omp simd
            for (int l = 0; l < SINGLE_LANES; l++) {
                float f = 0.0f;
                int at = stride;
#pragma GCC unroll 6
                for (int i = DEGREE; i >= 0; i--) {
                    float g = 0.0f;
#pragma GCC unroll 6
                    for (int j = DEGREE - i; j >= 0; j--) {
                        float h = component[--at];
#pragma GCC unroll 6
                        for (int k = DEGREE - i - j; k > 0; k--)
                            h = h * z[l] + component[--at];
                        g = g * y[l] + h;
                    }
                    f = f * x[l] + g;
                }
                field[axis * m + first + l] += f;
            }
        }
    }
}

/* The sums of a patch of about 300 atoms are in single precision, with coordinates relative to the hole. The length of
 * the rows is a multiple of PATCH_LANES, padded with atoms without charge: with fewer than four registers the additions
 * of a dot product wait for each other. */
#define PATCH_LANES 64

/* One column of the Robin matrix: column[k] = factor n_k . (r_k - p)/|r_k - p|^3 for the atom at p, with the normals n;
 * and cubes[k] = 1/|r_k - p|^3. */
APT_CLONES static void patch_column(Index n, const float *restrict x, const float *restrict y, const float *restrict z,
                                    const float *restrict nx, const float *restrict ny, const float *restrict nz,
                                    float px, float py, float pz, float factor, float *restrict column,
                                    float *restrict cubes)
{
#pragma omp simd
    for (Index k = 0; k < n; k++) {
        const float dx = x[k] - px, dy = y[k] - py, dz = z[k] - pz;
        const float s = dx * dx + dy * dy + dz * dz;
        const float cube = s > (float)SAME_PLACE ? 1.0f / (s * sqrtf(s)) : 0.0f;
        cubes[k] = cube;
        column[k] = factor * (nx[k] * dx + ny[k] * dy + nz[k] * dz) * cube;
    }
}

/* One Gauss-Seidel iteration of the changes: each in turn becomes its right side, and its step times its column is added
 * to all right sides. Returns the largest step. Columns go by blocks of PATCH_LANES atoms: the steps of a block first
 * change its own right sides, then those of each other block, which stay in registers. */
APT_CLONES static float patch_iteration(Index n, Index stride, const float *restrict columns, float *restrict right,
                                        float *restrict change)
{
    float largest = 0.0f;
    for (Index first = 0; first < n; first += PATCH_LANES) {
        const Index m = n - first < PATCH_LANES ? n - first : PATCH_LANES;
        const float *restrict block = columns + first * stride;
        float step[PATCH_LANES];
        for (Index i = 0; i < m; i++) {
            const float *restrict column = block + i * stride + first;
            float *restrict own = right + first;
            const float factor = own[i] - change[first + i];
            step[i] = factor;
            largest = fabsf(factor) > largest ? fabsf(factor) : largest;
            change[first + i] = own[i];
#pragma omp simd
            for (int l = 0; l < PATCH_LANES; l++)
                own[l] += factor * column[l];
        }
        for (Index other = 0; other < stride; other += PATCH_LANES) {
            float sum[PATCH_LANES];
            if (other == first)
                continue;
            memcpy(sum, right + other, sizeof sum);
            for (Index i = 0; i < m; i++) {
                const float *restrict column = block + i * stride + other;
                const float factor = step[i];
#pragma omp simd
                for (int l = 0; l < PATCH_LANES; l++)
                    sum[l] += factor * column[l];
            }
            memcpy(right + other, sum, sizeof sum);
        }
    }
    return largest;
}

/* Field of the n charges q of a patch at its atoms, from 1/r^3 in n rows of `stride` numbers: sum w (r - r_i) with
 * w = q_i/r^3, as r sum w - sum w r_i. */
APT_CLONES static void patch_field_of_cubes(Index n, Index stride, const float *restrict cubes, const float *restrict x,
                                            const float *restrict y, const float *restrict z, const float *restrict q,
                                            float *restrict field_x, float *restrict field_y, float *restrict field_z)
{
    for (Index first = 0; first < stride; first += GROUP) {
        float sum[GROUP] = {0}, sx[GROUP] = {0}, sy[GROUP] = {0}, sz[GROUP] = {0};
        for (Index i = 0; i < n; i++) {
            const float *restrict row = cubes + i * stride + first;
            const float charge = q[i], px = x[i], py = y[i], pz = z[i];
#pragma omp simd
            for (int l = 0; l < GROUP; l++) {
                const float w = charge * row[l];
                sum[l] += w;
                sx[l] += w * px;
                sy[l] += w * py;
                sz[l] += w * pz;
            }
        }
#pragma omp simd
        for (int l = 0; l < GROUP; l++) {
            field_x[first + l] = sum[l] * x[first + l] - sx[l];
            field_y[first + l] = sum[l] * y[first + l] - sy[l];
            field_z[first + l] = sum[l] * z[first + l] - sz[l];
        }
    }
}

/* The same from 1/r, whose value for an atom itself does not matter. */
APT_CLONES static void patch_field_of_inverse(Index n, Index stride, const float *restrict inverse,
                                              const float *restrict x, const float *restrict y, const float *restrict z,
                                              const float *restrict q, float *restrict field_x, float *restrict field_y,
                                              float *restrict field_z)
{
    for (Index first = 0; first < stride; first += GROUP) {
        float ex[GROUP] = {0}, ey[GROUP] = {0}, ez[GROUP] = {0};
        const float *restrict tx = x + first, *restrict ty = y + first, *restrict tz = z + first;
        for (Index i = 0; i < n; i++) {
            const float *restrict row = inverse + i * stride + first;
            const float charge = q[i], px = x[i], py = y[i], pz = z[i];
#pragma omp simd
            for (int l = 0; l < GROUP; l++) {
                const float w = charge * (row[l] * row[l] * row[l]);
                ex[l] += w * (tx[l] - px);
                ey[l] += w * (ty[l] - py);
                ez[l] += w * (tz[l] - pz);
            }
        }
        memcpy(field_x + first, ex, sizeof ex);
        memcpy(field_y + first, ey, sizeof ey);
        memcpy(field_z + first, ez, sizeof ez);
    }
}

/* Product of n columns of `stride` numbers with the numbers a: no sums over lanes, which take as long as the products. */
APT_CLONES static void patch_product(Index n, Index stride, const float *restrict columns, const float *restrict a,
                                     float *restrict product)
{
    for (Index first = 0; first < stride; first += PATCH_LANES) {
        float sum[PATCH_LANES] = {0};
        for (Index k = 0; k < n; k++) {
            const float *restrict column = columns + k * stride + first;
            const float factor = a[k];
#pragma omp simd
            for (int l = 0; l < PATCH_LANES; l++)
                sum[l] += factor * column[l];
        }
        memcpy(product + first, sum, sizeof sum);
    }
}

/* Dot product in PATCH_LANES fixed partial sums. */
APT_CLONES static float patch_dot(Index n, const float *restrict a, const float *restrict b)
{
    float sum[PATCH_LANES] = {0}, s[16];
    for (Index k = 0; k < n; k += PATCH_LANES) {
#pragma omp simd
        for (int l = 0; l < PATCH_LANES; l++)
            sum[l] += a[k + l] * b[k + l];
    }
#pragma omp simd
    for (int l = 0; l < 16; l++)
        s[l] = (sum[l] + sum[16 + l]) + (sum[32 + l] + sum[48 + l]);
    return (((s[0] + s[8]) + (s[4] + s[12])) + ((s[2] + s[10]) + (s[6] + s[14])))
         + (((s[1] + s[9]) + (s[5] + s[13])) + ((s[3] + s[11]) + (s[7] + s[15])));
}

/* One row of the potential matrix: row[k] = 1/|p - r_k|, and `self` for the atom at p. */
APT_CLONES static void patch_row_potential(Index n, const float *restrict x, const float *restrict y,
                                           const float *restrict z, float px, float py, float pz, float self,
                                           float *restrict row)
{
#pragma omp simd
    for (Index k = 0; k < n; k++) {
        const float dx = px - x[k], dy = py - y[k], dz = pz - z[k];
        const float s = dx * dx + dy * dy + dz * dz;
        row[k] = s > (float)SAME_PLACE ? 1.0f / sqrtf(s) : self;
    }
}

/* Adds the field of the n charges q of the patch at m targets, all relative to the hole; m is a multiple of GROUP.
 * Targets are in the lanes: with the sources in the lanes, the sum over the lanes takes longer than the terms. The sums
 * start from the values in memory and each source has its own variables; otherwise GCC 12 replaces the lanes by scalars
 * (16 times slower). */
APT_CLONES static void patch_field(Index m, const float *restrict targets_x, const float *restrict targets_y,
                                   const float *restrict targets_z, Index n, const float *restrict x,
                                   const float *restrict y, const float *restrict z, const float *restrict q,
                                   float *restrict field_x, float *restrict field_y, float *restrict field_z)
{
    for (Index k = 0; k < m; k += GROUP) {
        float tx[GROUP], ty[GROUP], tz[GROUP], ex[GROUP], ey[GROUP], ez[GROUP];
        memcpy(tx, targets_x + k, sizeof tx);
        memcpy(ty, targets_y + k, sizeof ty);
        memcpy(tz, targets_z + k, sizeof tz);
        memcpy(ex, field_x + k, sizeof ex);
        memcpy(ey, field_y + k, sizeof ey);
        memcpy(ez, field_z + k, sizeof ez);
        for (Index i = 0; i < n; i++) {
            const float sx = x[i], sy = y[i], sz = z[i], charge = q[i];
#pragma omp simd
            for (int l = 0; l < GROUP; l++) {
                const float dx = tx[l] - sx, dy = ty[l] - sy, dz = tz[l] - sz;
                const float s = dx * dx + dy * dy + dz * dz;
                const float w = s > (float)SAME_PLACE ? charge / (s * sqrtf(s)) : 0.0f;
                ex[l] += w * dx;
                ey[l] += w * dy;
                ez[l] += w * dz;
            }
        }
        memcpy(field_x + k, ex, sizeof ex);
        memcpy(field_y + k, ey, sizeof ey);
        memcpy(field_z + k, ez, sizeof ez);
    }
}

/* Adds the potential of the n charges q of the patch at m targets; see patch_field. */
APT_CLONES static void patch_potential(Index m, const float *restrict targets_x, const float *restrict targets_y,
                                       const float *restrict targets_z, Index n, const float *restrict x,
                                       const float *restrict y, const float *restrict z, const float *restrict q,
                                       float *restrict potential)
{
    for (Index k = 0; k < m; k += GROUP) {
        float tx[GROUP], ty[GROUP], tz[GROUP], sum[GROUP];
        memcpy(tx, targets_x + k, sizeof tx);
        memcpy(ty, targets_y + k, sizeof ty);
        memcpy(tz, targets_z + k, sizeof tz);
        memcpy(sum, potential + k, sizeof sum);
        for (Index i = 0; i < n; i++) {
            const float sx = x[i], sy = y[i], sz = z[i], charge = q[i];
#pragma omp simd
            for (int l = 0; l < GROUP; l++) {
                const float dx = tx[l] - sx, dy = ty[l] - sy, dz = tz[l] - sz;
                const float s = dx * dx + dy * dy + dz * dz;
                sum[l] += s > (float)SAME_PLACE ? charge / sqrtf(s) : 0.0f;
            }
        }
        memcpy(potential + k, sum, sizeof sum);
    }
}

/* Adds both; see patch_field. The inverse distance is used for the potential and the field. */
APT_CLONES static void patch_potential_and_field(
    Index m, const float *restrict targets_x, const float *restrict targets_y, const float *restrict targets_z, Index n,
    const float *restrict x, const float *restrict y, const float *restrict z, const float *restrict q,
    float *restrict potential, float *restrict field_x, float *restrict field_y, float *restrict field_z)
{
    for (Index k = 0; k < m; k += GROUP) {
        float tx[GROUP], ty[GROUP], tz[GROUP], sum[GROUP], ex[GROUP], ey[GROUP], ez[GROUP];
        memcpy(tx, targets_x + k, sizeof tx);
        memcpy(ty, targets_y + k, sizeof ty);
        memcpy(tz, targets_z + k, sizeof tz);
        memcpy(sum, potential + k, sizeof sum);
        memcpy(ex, field_x + k, sizeof ex);
        memcpy(ey, field_y + k, sizeof ey);
        memcpy(ez, field_z + k, sizeof ez);
        for (Index i = 0; i < n; i++) {
            const float sx = x[i], sy = y[i], sz = z[i], charge = q[i];
#pragma omp simd
            for (int l = 0; l < GROUP; l++) {
                const float dx = tx[l] - sx, dy = ty[l] - sy, dz = tz[l] - sz;
                const float s = dx * dx + dy * dy + dz * dz;
                const float inverse = s > (float)SAME_PLACE ? 1.0f / sqrtf(s) : 0.0f;
                const float v = charge * inverse, w = v * inverse * inverse;
                sum[l] += v;
                ex[l] += w * dx;
                ey[l] += w * dy;
                ez[l] += w * dz;
            }
        }
        memcpy(potential + k, sum, sizeof sum);
        memcpy(field_x + k, ex, sizeof ex);
        memcpy(field_y + k, ey, sizeof ey);
        memcpy(field_z + k, ez, sizeof ez);
    }
}
#endif
