/* Included by kernels.h, once for float and once for double: 32 targets in the vector lanes, a loop over the sources.
 *
 * Source coordinates are relative to `origin` (the centre of the group) before they are rounded to REAL, so that single
 * precision has no loss by cancellation. targets and field contain x[32], y[32], z[32]; values are added to field.
 */

/* Atoms in n_ranges ranges [ranges[2 k], ranges[2 k + 1]). */
APT_CLONES static void GROUP_NAME(group_atoms)(long n_ranges, const int *ranges, const double *x, const double *y,
                                               const double *z, const double *q, const double *origin,
                                               const REAL *restrict targets, REAL *restrict field)
{
    REAL tx[GROUP], ty[GROUP], tz[GROUP], ex[GROUP], ey[GROUP], ez[GROUP];
    memcpy(tx, targets, sizeof tx);
    memcpy(ty, targets + GROUP, sizeof ty);
    memcpy(tz, targets + 2 * GROUP, sizeof tz);
    memcpy(ex, field, sizeof ex);
    memcpy(ey, field + GROUP, sizeof ey);
    memcpy(ez, field + 2 * GROUP, sizeof ez);
    for (long range = 0; range < n_ranges; range++) {
        for (long k = ranges[2 * range]; k < ranges[2 * range + 1]; k++) {
            const REAL sx = (REAL)(x[k] - origin[0]), sy = (REAL)(y[k] - origin[1]), sz = (REAL)(z[k] - origin[2]);
            const REAL charge = (REAL)q[k];
#pragma omp simd
            for (int l = 0; l < GROUP; l++) {
                const REAL dx = tx[l] - sx, dy = ty[l] - sy, dz = tz[l] - sz;
                const REAL s = dx * dx + dy * dy + dz * dz;
                const REAL w = s > (REAL)SAME_PLACE ? charge / (s * REAL_SQRT(s)) : (REAL)0;
                ex[l] += w * dx;
                ey[l] += w * dy;
                ez[l] += w * dz;
            }
        }
    }
    memcpy(field, ex, sizeof ex);
    memcpy(field + GROUP, ey, sizeof ey);
    memcpy(field + 2 * GROUP, ez, sizeof ez);
}

/* Cells by their indices. The loop over the lanes is in two halves, with a start that GCC 12 cannot analyse; otherwise
 * it replaces all 32 lanes by scalars (12 times slower). */
APT_CLONES static void GROUP_NAME(group_cells)(long n, const int *list, const double *cells, const double *origin,
                                               const REAL *restrict targets, REAL *restrict field)
{
    REAL tx[GROUP], ty[GROUP], tz[GROUP], ex[GROUP], ey[GROUP], ez[GROUP];
    memcpy(tx, targets, sizeof tx);
    memcpy(ty, targets + GROUP, sizeof ty);
    memcpy(tz, targets + 2 * GROUP, sizeof tz);
    memcpy(ex, field, sizeof ex);
    memcpy(ey, field + GROUP, sizeof ey);
    memcpy(ez, field + 2 * GROUP, sizeof ez);
    for (long k = 0; k < n; k++) {
        const double *cell = cells + CELL * (long)list[k];
        const REAL sx = (REAL)(cell[0] - origin[0]), sy = (REAL)(cell[1] - origin[1]);
        const REAL sz = (REAL)(cell[2] - origin[2]), charge = (REAL)cell[3];
        const REAL xx = (REAL)cell[4], xy = (REAL)cell[5], xz = (REAL)cell[6];
        const REAL yy = (REAL)cell[7], yz = (REAL)cell[8], zz = (REAL)cell[9];
        for (int h = 0; h < GROUP; h += 16)
#pragma omp simd
            for (int l = h; l < h + 16; l++) {
                const REAL dx = tx[l] - sx, dy = ty[l] - sy, dz = tz[l] - sz;
                const REAL w2 = (REAL)1 / (dx * dx + dy * dy + dz * dz);
                const REAL w3 = w2 * REAL_SQRT(w2), w5 = w3 * w2;
                const REAL gx = xx * dx + xy * dy + xz * dz;
                const REAL gy = xy * dx + yy * dy + yz * dz;
                const REAL gz = xz * dx + yz * dy + zz * dz;
                const REAL radial = charge * w3 + (REAL)2.5 * w5 * w2 * (gx * dx + gy * dy + gz * dz);
                ex[l] += radial * dx - w5 * gx;
                ey[l] += radial * dy - w5 * gy;
                ez[l] += radial * dz - w5 * gz;
            }
    }
    memcpy(field, ex, sizeof ex);
    memcpy(field + GROUP, ey, sizeof ey);
    memcpy(field + 2 * GROUP, ez, sizeof ez);
}
