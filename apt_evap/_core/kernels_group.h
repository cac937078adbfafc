/* Included by kernels.h, once for float and once for double: 32 targets in the vector lanes, a loop over the sources.
 *
 * Source coordinates are relative to `origin` (the centre of the group) before they are rounded to REAL, so that single
 * precision has no loss by cancellation. targets and field contain x[32], y[32], z[32]; values are added to field.
 */

/* Atoms in n_ranges ranges [ranges[2 k], ranges[2 k + 1]). */
APT_CLONES static void GROUP_NAME(group_atoms)(Index n_ranges, const int *ranges, const double *x, const double *y,
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
    for (Index range = 0; range < n_ranges; range++) {
        for (Index k = ranges[2 * range]; k < ranges[2 * range + 1]; k++) {
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
APT_CLONES static void GROUP_NAME(group_cells)(Index n, const int *list, const double *cells, const double *origin,
                                               const REAL *restrict targets, REAL *restrict field)
{
    REAL tx[GROUP], ty[GROUP], tz[GROUP], ex[GROUP], ey[GROUP], ez[GROUP];
    memcpy(tx, targets, sizeof tx);
    memcpy(ty, targets + GROUP, sizeof ty);
    memcpy(tz, targets + 2 * GROUP, sizeof tz);
    memcpy(ex, field, sizeof ex);
    memcpy(ey, field + GROUP, sizeof ey);
    memcpy(ez, field + 2 * GROUP, sizeof ez);
    for (Index k = 0; k < n; k++) {
        const double *cell = cells + CELL * (Index)list[k];
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

/* Cells that have only a charge, in the middle of their ball; in two halves as above. */
APT_CLONES static void GROUP_NAME(group_charges)(Index n, const int *list, const double *balls, const double *charges,
                                                 const double *origin, const REAL *restrict targets,
                                                 REAL *restrict field)
{
    REAL tx[GROUP], ty[GROUP], tz[GROUP], ex[GROUP], ey[GROUP], ez[GROUP];
    memcpy(tx, targets, sizeof tx);
    memcpy(ty, targets + GROUP, sizeof ty);
    memcpy(tz, targets + 2 * GROUP, sizeof tz);
    memcpy(ex, field, sizeof ex);
    memcpy(ey, field + GROUP, sizeof ey);
    memcpy(ez, field + 2 * GROUP, sizeof ez);
    for (Index k = 0; k < n; k++) {
        const double *ball = balls + 4 * (Index)list[k];
        const REAL sx = (REAL)(ball[0] - origin[0]), sy = (REAL)(ball[1] - origin[1]);
        const REAL sz = (REAL)(ball[2] - origin[2]), charge = (REAL)charges[list[k]];
        for (int h = 0; h < GROUP; h += 16)
#pragma omp simd
            for (int l = h; l < h + 16; l++) {
                const REAL dx = tx[l] - sx, dy = ty[l] - sy, dz = tz[l] - sz;
                const REAL s = dx * dx + dy * dy + dz * dz;
                const REAL w = charge / (s * REAL_SQRT(s));
                ex[l] += w * dx;
                ey[l] += w * dy;
                ez[l] += w * dz;
            }
    }
    memcpy(field, ex, sizeof ex);
    memcpy(field + GROUP, ey, sizeof ey);
    memcpy(field + 2 * GROUP, ez, sizeof ez);
}

/* Potentials: partial sums over at most CHUNK sources in REAL, starting from `zero`, are added to `potential` in double,
 * because a potential is a sum of many terms of one sign, of which only small differences matter. `zero` is an array of
 * GROUP zeros in memory: with a constant, GCC 12 replaces the lanes by scalars. */
APT_CLONES static void GROUP_NAME(group_atoms_potential)(Index n_ranges, const int *ranges, const double *x,
                                                         const double *y, const double *z, const double *q,
                                                         const double *origin, const REAL *restrict targets,
                                                         const REAL *restrict zero, double *restrict potential)
{
    REAL tx[GROUP], ty[GROUP], tz[GROUP];
    memcpy(tx, targets, sizeof tx);
    memcpy(ty, targets + GROUP, sizeof ty);
    memcpy(tz, targets + 2 * GROUP, sizeof tz);
    for (Index range = 0; range < n_ranges; range++) {
        for (Index first = ranges[2 * range]; first < ranges[2 * range + 1]; first += CHUNK) {
            const Index last = first + CHUNK < ranges[2 * range + 1] ? first + CHUNK : ranges[2 * range + 1];
            REAL sum[GROUP];
            memcpy(sum, zero, sizeof sum);
            for (Index k = first; k < last; k++) {
                const REAL sx = (REAL)(x[k] - origin[0]), sy = (REAL)(y[k] - origin[1]), sz = (REAL)(z[k] - origin[2]);
                const REAL charge = (REAL)q[k];
#pragma omp simd
                for (int l = 0; l < GROUP; l++) {
                    const REAL dx = tx[l] - sx, dy = ty[l] - sy, dz = tz[l] - sz;
                    const REAL s = dx * dx + dy * dy + dz * dz;
                    sum[l] += s > (REAL)SAME_PLACE ? charge / REAL_SQRT(s) : (REAL)0;
                }
            }
            for (int l = 0; l < GROUP; l++)
                potential[l] += sum[l];
        }
    }
}

/* Cells by their indices, with charge, dipole, quadrupole and octupole about the centre of their ball. */
APT_CLONES static void GROUP_NAME(group_cells_potential)(Index n, const int *list, const double *cells,
                                                         const double *origin, const REAL *restrict targets,
                                                         const REAL *restrict zero, double *restrict potential)
{
    REAL tx[GROUP], ty[GROUP], tz[GROUP];
    memcpy(tx, targets, sizeof tx);
    memcpy(ty, targets + GROUP, sizeof ty);
    memcpy(tz, targets + 2 * GROUP, sizeof tz);
    for (Index first = 0; first < n; first += CHUNK) {
        const Index last = first + CHUNK < n ? first + CHUNK : n;
        REAL sum[GROUP];
        memcpy(sum, zero, sizeof sum);
        for (Index k = first; k < last; k++) {
            const double *cell = cells + MULTIPOLE * (Index)list[k];
            const REAL sx = (REAL)(cell[0] - origin[0]), sy = (REAL)(cell[1] - origin[1]);
            const REAL sz = (REAL)(cell[2] - origin[2]), charge = (REAL)cell[3];
            const REAL px = (REAL)cell[4], py = (REAL)cell[5], pz = (REAL)cell[6];
            const REAL xx = (REAL)cell[7], xy = (REAL)cell[8], xz = (REAL)cell[9];
            const REAL yy = (REAL)cell[10], yz = (REAL)cell[11], zz = (REAL)cell[12];
            const REAL xxx = (REAL)cell[13], xxy = (REAL)cell[14], xxz = (REAL)cell[15], xyy = (REAL)cell[16];
            const REAL xyz = (REAL)cell[17], xzz = (REAL)cell[18], yyy = (REAL)cell[19], yyz = (REAL)cell[20];
            const REAL yzz = (REAL)cell[21], zzz = (REAL)cell[22];
            for (int h = 0; h < GROUP; h += 16)
#pragma omp simd
                for (int l = h; l < h + 16; l++) {
                    const REAL dx = tx[l] - sx, dy = ty[l] - sy, dz = tz[l] - sz;
                    const REAL w2 = (REAL)1 / (dx * dx + dy * dy + dz * dz);
                    const REAL first_order = px * dx + py * dy + pz * dz;
                    const REAL second = dx * (xx * dx + xy * dy + xz * dz) + dy * (yy * dy + yz * dz) + zz * dz * dz;
                    const REAL third = dx * (dx * (xxx * dx + xxy * dy + xxz * dz) + dy * (xyy * dy + xyz * dz))
                                     + dy * dy * (yyy * dy + yyz * dz) + dz * dz * (xzz * dx + yzz * dy + zzz * dz);
                    sum[l] += REAL_SQRT(w2) * (charge + w2 * (first_order + w2 * (second + w2 * third)));
                }
        }
        for (int l = 0; l < GROUP; l++)
            potential[l] += sum[l];
    }
}
