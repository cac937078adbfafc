/* Included by kernels.h: the flights of a bundle, with the flights in the vector lanes and a loop over the sources.
 * Coordinates are relative to a point near the targets, so that single precision has no loss by cancellation.
 * targets and field contain x[m], y[m], z[m], with m a multiple of SINGLE_LANES; values are added to field. Each target
 * has its sums in the order of the sources, whatever its lane is.
 */

/* Field of n point charges; atoms holds x, y, z and q in columns of `stride` numbers. */
APT_CLONES static void bundle_atoms(Index n, Index stride, const float *restrict atoms, Index m,
                                    const float *restrict targets, float *restrict field)
{
    const float *restrict x = atoms, *restrict y = atoms + stride, *restrict z = atoms + 2 * stride;
    const float *restrict q = atoms + 3 * stride;
    for (Index first = 0; first < m; first += SINGLE_LANES) {
        float tx[SINGLE_LANES], ty[SINGLE_LANES], tz[SINGLE_LANES];
        float ex[SINGLE_LANES], ey[SINGLE_LANES], ez[SINGLE_LANES];
        memcpy(tx, targets + first, sizeof tx);
        memcpy(ty, targets + m + first, sizeof ty);
        memcpy(tz, targets + 2 * m + first, sizeof tz);
        memcpy(ex, field + first, sizeof ex);
        memcpy(ey, field + m + first, sizeof ey);
        memcpy(ez, field + 2 * m + first, sizeof ez);
        for (Index k = 0; k < n; k++) {
            const float sx = x[k], sy = y[k], sz = z[k], charge = q[k];
#pragma omp simd
            for (int l = 0; l < SINGLE_LANES; l++) {
                const float dx = tx[l] - sx, dy = ty[l] - sy, dz = tz[l] - sz;
                const float s = dx * dx + dy * dy + dz * dz;
                const float w = s > (float)SAME_PLACE ? charge / (s * sqrtf(s)) : 0.0f;
                ex[l] += w * dx;
                ey[l] += w * dy;
                ez[l] += w * dz;
            }
        }
        memcpy(field + first, ex, sizeof ex);
        memcpy(field + m + first, ey, sizeof ey);
        memcpy(field + 2 * m + first, ez, sizeof ez);
    }
}

/* Field of n cells; cells holds CELL columns of `stride` numbers. */
APT_CLONES static void bundle_cells(Index n, Index stride, const float *restrict cells, Index m,
                                    const float *restrict targets, float *restrict field)
{
    for (Index first = 0; first < m; first += SINGLE_LANES) {
        float tx[SINGLE_LANES], ty[SINGLE_LANES], tz[SINGLE_LANES];
        float ex[SINGLE_LANES], ey[SINGLE_LANES], ez[SINGLE_LANES];
        memcpy(tx, targets + first, sizeof tx);
        memcpy(ty, targets + m + first, sizeof ty);
        memcpy(tz, targets + 2 * m + first, sizeof tz);
        memcpy(ex, field + first, sizeof ex);
        memcpy(ey, field + m + first, sizeof ey);
        memcpy(ez, field + 2 * m + first, sizeof ez);
        for (Index k = 0; k < n; k++) {
            const float *cell = cells + k;
            const float sx = cell[0], sy = cell[stride], sz = cell[2 * stride], charge = cell[3 * stride];
            const float xx = cell[4 * stride], xy = cell[5 * stride], xz = cell[6 * stride];
            const float yy = cell[7 * stride], yz = cell[8 * stride], zz = cell[9 * stride];
#pragma omp simd
            for (int l = 0; l < SINGLE_LANES; l++) {
                const float dx = tx[l] - sx, dy = ty[l] - sy, dz = tz[l] - sz;
                const float w2 = 1.0f / (dx * dx + dy * dy + dz * dz);
                const float w3 = w2 * sqrtf(w2), w5 = w3 * w2;
                const float gx = xx * dx + xy * dy + xz * dz;
                const float gy = xy * dx + yy * dy + yz * dz;
                const float gz = xz * dx + yz * dy + zz * dz;
                const float radial = charge * w3 + 2.5f * w5 * w2 * (gx * dx + gy * dy + gz * dz);
                ex[l] += radial * dx - w5 * gx;
                ey[l] += radial * dy - w5 * gy;
                ez[l] += radial * dz - w5 * gz;
            }
        }
        memcpy(field + first, ex, sizeof ex);
        memcpy(field + m + first, ey, sizeof ey);
        memcpy(field + 2 * m + first, ez, sizeof ez);
    }
}

/* sums[j] = sum over k of weights[k] rows[k * stride + j], for n numbers j. */
APT_CLONES static void weighted_sum(Index n, int n_rows, const double *restrict weights, const double *restrict rows,
                                    Index stride, double *restrict sums)
{
    for (Index j = 0; j < n; j++)
        sums[j] = 0.0;
    for (int k = 0; k < n_rows; k++) {
        const double *row = rows + k * stride;
        const double weight = weights[k];
#pragma omp simd
        for (Index j = 0; j < n; j++)
            sums[j] += weight * row[j];
    }
}
