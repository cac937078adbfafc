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

/* sums[j] = sum over k of weights[k] rows[k * stride + j], for n numbers j; blocks of sums stay in registers. */
#define BLOCK 32
APT_CLONES static void weighted_sum(Index n, int n_rows, const double *restrict weights, const double *restrict rows,
                                    Index stride, double *restrict sums)
{
    Index first = 0;
    for (; first + BLOCK <= n; first += BLOCK) {
        double sum[BLOCK] = {0};
        for (int k = 0; k < n_rows; k++) {
            const double *restrict row = rows + k * stride + first;
            const double weight = weights[k];
#pragma omp simd
            for (int j = 0; j < BLOCK; j++)
                sum[j] += weight * row[j];
        }
        memcpy(sums + first, sum, sizeof sum);
    }
    for (; first < n; first++) {
        double sum = 0.0;
        for (int k = 0; k < n_rows; k++)
            sum += weights[k] * rows[k * stride + first];
        sums[first] = sum;
    }
}

/* The steps of a bundle: rows x, y and z of `width` numbers each, in double precision. */

/* Places of a stage: x + dt (node v + dt sums), for n numbers. */
APT_CLONES static void stage_places(Index n, double dt, double node, const double *restrict x,
                                    const double *restrict v, const double *restrict sums, double *restrict places)
{
#pragma omp simd
    for (Index j = 0; j < n; j++)
        places[j] = x[j] + dt * (node * v[j] + dt * sums[j]);
}

/* Single precision, relative to the origin. */
APT_CLONES static void into_lanes(Index width, const double *restrict x, const double *restrict origin,
                                  float *restrict lanes)
{
    for (int axis = 0; axis < 3; axis++) {
        const double shift = origin[axis];
#pragma omp simd
        for (Index k = 0; k < width; k++)
            lanes[axis * width + k] = (float)(x[axis * width + k] - shift);
    }
}

/* Back to double precision, with a factor, for n numbers, a multiple of SINGLE_LANES: with AVX-512 and any n, GCC 12
 * rounds a constant factor to single precision for the last few numbers. */
APT_CLONES static void out_of_lanes(Index n, double factor, const float *restrict lanes, double *restrict values)
{
    for (Index k = 0; k < n; k += SINGLE_LANES) {
#pragma omp simd
        for (int l = 0; l < SINGLE_LANES; l++)
            values[k + l] = factor * lanes[k + l];
    }
}

/* Centre and radius of a ball around all flights at two times of the step. */
APT_CLONES static void enclosing_ball(Index width, const double *restrict x, const double *restrict v,
                                      const double *restrict a, double begin, double end, double *restrict ball)
{
    const double mean = 0.5 * (begin + end), half = 0.25 * (begin * begin + end * end);
    const double begin2 = 0.5 * begin * begin, end2 = 0.5 * end * end;
    double largest[LANES] = {0};
    for (int axis = 0; axis < 3; axis++) {
        const double *restrict xs = x + axis * width, *restrict vs = v + axis * width, *restrict as = a + axis * width;
        double sum[LANES] = {0}, total = 0.0;
        for (Index k = 0; k + LANES <= width; k += LANES) {
#pragma omp simd
            for (int l = 0; l < LANES; l++)
                sum[l] += xs[k + l] + mean * vs[k + l] + half * as[k + l];
        }
        for (Index k = width - width % LANES; k < width; k++)
            sum[k % LANES] += xs[k] + mean * vs[k] + half * as[k];
        for (int l = 0; l < LANES; l++)
            total += sum[l];
        ball[axis] = total / width;
    }
    for (Index k = 0; k < width; k += LANES) {
        const Index m = width - k < LANES ? width - k : LANES;
        double first[LANES] = {0}, last[LANES] = {0};
        for (int axis = 0; axis < 3; axis++) {
            const double *restrict xs = x + axis * width + k, *restrict vs = v + axis * width + k;
            const double *restrict as = a + axis * width + k;
            const double centre = ball[axis];
#pragma omp simd
            for (int l = 0; l < m; l++) {
                const double s = xs[l] - centre;
                const double f = s + begin * vs[l] + begin2 * as[l], g = s + end * vs[l] + end2 * as[l];
                first[l] += f * f;
                last[l] += g * g;
            }
        }
        for (int l = 0; l < LANES; l++) {
            const double s = first[l] > last[l] ? first[l] : last[l];
            largest[l] = s > largest[l] ? s : largest[l];
        }
    }
    ball[3] = 0.0;
    for (int l = 0; l < LANES; l++)
        ball[3] = largest[l] > ball[3] ? largest[l] : ball[3];
    ball[3] = sqrt(ball[3]);
}

/* For each flight scale |sums| / (|p - q| + more). */
APT_CLONES static void relative_lengths(Index width, double scale, double more, const double *restrict sums,
                                        const double *restrict p, const double *restrict q, double *restrict result)
{
    const double *restrict sy = sums + width, *restrict sz = sums + 2 * width;
    const double *restrict py = p + width, *restrict pz = p + 2 * width;
    const double *restrict qy = q + width, *restrict qz = q + 2 * width;
#pragma omp simd
    for (Index k = 0; k < width; k++) {
        const double s = sums[k] * sums[k] + sy[k] * sy[k] + sz[k] * sz[k];
        const double x = p[k] - q[k], y = py[k] - qy[k], z = pz[k] - qz[k];
        result[k] = scale * sqrt(s) / (sqrt(x * x + y * y + z * z) + more);
    }
}
