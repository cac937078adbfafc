/* Included by kernels.h, once for float and once for double: sources in POINT_LANES vector lanes, one target. Values
 * are added to field[3] in double precision. In single precision, the caller gives coordinates relative to a point near
 * the target, so that there is no loss by cancellation. Measured on an Intel Xeon with AVX-512: 1.9 Gpair/s of atoms in
 * single precision, 3.3 times the rate in double; the square roots and divisions take most of the time. A reciprocal
 * square root by Newton steps makes 2.3 Gpair/s at an error of 1e-6.
 */

/* Adds the field of n point charges at (px, py, pz). */
APT_CLONES static void POINT_NAME(point_atoms)(Index n, const REAL *restrict x, const REAL *restrict y,
                                                const REAL *restrict z, const REAL *restrict q, REAL px, REAL py,
                                                REAL pz, double *restrict field)
{
    REAL ex[POINT_LANES] = {0}, ey[POINT_LANES] = {0}, ez[POINT_LANES] = {0};
    for (Index k = 0; k + POINT_LANES <= n; k += POINT_LANES) {
#pragma omp simd
        for (int l = 0; l < POINT_LANES; l++) {
            const REAL dx = px - x[k + l], dy = py - y[k + l], dz = pz - z[k + l];
            const REAL s = dx * dx + dy * dy + dz * dz;
            const REAL w = s > (REAL)SAME_PLACE ? q[k + l] / (s * REAL_SQRT(s)) : (REAL)0;
            ex[l] += w * dx;
            ey[l] += w * dy;
            ez[l] += w * dz;
        }
    }
    for (Index k = n - n % POINT_LANES; k < n; k++) {
        const REAL dx = px - x[k], dy = py - y[k], dz = pz - z[k];
        const REAL s = dx * dx + dy * dy + dz * dz;
        const REAL w = s > (REAL)SAME_PLACE ? q[k] / (s * REAL_SQRT(s)) : (REAL)0;
        ex[k % POINT_LANES] += w * dx;
        ey[k % POINT_LANES] += w * dy;
        ez[k % POINT_LANES] += w * dz;
    }
    for (int l = 0; l < POINT_LANES; l++) {
        field[0] += ex[l];
        field[1] += ey[l];
        field[2] += ez[l];
    }
}

/* Adds the field of n cells at (px, py, pz) to field[3]; c holds CELL rows of `stride` numbers, n a multiple of
 * POINT_LANES (padded by the caller with cells without charge). */
APT_CLONES static void POINT_NAME(point_cells)(Index n, Index stride, const REAL *restrict c, REAL px, REAL py,
                                                REAL pz, double *restrict field)
{
    const REAL *restrict x = c, *restrict y = c + stride, *restrict z = c + 2 * stride, *restrict q = c + 3 * stride;
    const REAL *restrict xx = c + 4 * stride, *restrict xy = c + 5 * stride, *restrict xz = c + 6 * stride;
    const REAL *restrict yy = c + 7 * stride, *restrict yz = c + 8 * stride, *restrict zz = c + 9 * stride;
    REAL ex[POINT_LANES] = {0}, ey[POINT_LANES] = {0}, ez[POINT_LANES] = {0};
    for (Index k = 0; k < n; k += POINT_LANES) {
#pragma omp simd
        for (int l = 0; l < POINT_LANES; l++) {
            const Index j = k + l;
            const REAL dx = px - x[j], dy = py - y[j], dz = pz - z[j];
            const REAL w2 = (REAL)1 / (dx * dx + dy * dy + dz * dz);
            const REAL w3 = w2 * REAL_SQRT(w2), w5 = w3 * w2;
            const REAL gx = xx[j] * dx + xy[j] * dy + xz[j] * dz;
            const REAL gy = xy[j] * dx + yy[j] * dy + yz[j] * dz;
            const REAL gz = xz[j] * dx + yz[j] * dy + zz[j] * dz;
            const REAL radial = q[j] * w3 + (REAL)2.5 * w5 * w2 * (gx * dx + gy * dy + gz * dz);
            ex[l] += radial * dx - w5 * gx;
            ey[l] += radial * dy - w5 * gy;
            ez[l] += radial * dz - w5 * gz;
        }
    }
    for (int l = 0; l < POINT_LANES; l++) {
        field[0] += ex[l];
        field[1] += ey[l];
        field[2] += ez[l];
    }
}
