/* Elementary functions of one number, bit-identical on every processor and with every C library.
 *
 * Only additions, multiplications, divisions, square roots and exact operations on the exponent are used, in a fixed
 * order: these are rounded correctly on every processor (IEEE 754). The functions of C libraries are not always rounded
 * correctly, and their implementation depends on the processor. */

#include <math.h>

#include "index.h"

/* Horner's scheme; coefficients from the lowest order. */
static inline double horner(int n, const double *coefficient, double x)
{
    double value = coefficient[n - 1];
    for (int k = n - 2; k >= 0; k--) value = value * x + coefficient[k];
    return value;
}

/* Sine and cosine for |angle| <= 1e5; errors below 3e-16. Quarter turns are subtracted with pi / 2 as a sum of three
 * numbers. The first two have 33 bits, so that small multiples are exact. Taylor series for |x| <= pi / 4. */
static inline void sine_cosine(double angle, double *sine, double *cosine)
{
    static const double s[9] = {1.0, -0.16666666666666666, 0.008333333333333333, -0.0001984126984126984, 2.7557319223985893e-06,
        -2.505210838544172e-08, 1.6059043836821613e-10, -7.647163731819816e-13,
        2.8114572543455206e-15};
    static const double c[10] = {1.0, -0.5, 0.041666666666666664, -0.001388888888888889, 2.48015873015873e-05,
        -2.755731922398589e-07, 2.08767569878681e-09, -1.1470745597729725e-11,
        4.779477332387385e-14, -1.5619206968586225e-16};
    const double turns = rint(angle * 0.63661977236758134);
    const double x = ((angle - turns * 1.5707963267341256) - turns * 6.077100506303966e-11)
                     - turns * 2.0222662487959506e-21;
    const double a = x * horner(9, s, x * x), b = horner(10, c, x * x);
    const Index quarter = (Index)turns & 3;
    *sine = quarter == 0 ? a : quarter == 1 ? b : quarter == 2 ? -a : -b;
    *cosine = quarter == 0 ? b : quarter == 1 ? -a : quarter == 2 ? -b : a;
}

/* Arctangent; relative errors below 1e-15. The angle is halved twice: tan(a / 2) = t / (1 + sqrt(1 + t^2)). */
static inline double arc_tangent(double x)
{
    static const double c[13] = {1.0, -0.3333333333333333, 0.2, -0.14285714285714285, 0.1111111111111111, -0.09090909090909091,
        0.07692307692307693, -0.06666666666666667, 0.058823529411764705, -0.05263157894736842,
        0.047619047619047616, -0.043478260869565216, 0.04};
    const int reciprocal = fabs(x) > 1.0;
    double t = reciprocal ? 1.0 / x : x;
    t = t / (1.0 + sqrt(1.0 + t * t));
    t = t / (1.0 + sqrt(1.0 + t * t));
    t = 4.0 * t * horner(13, c, t * t);
    return reciprocal ? copysign(1.5707963267948966, x) - t : t;
}

/* Natural logarithm of a positive number; relative errors below 5e-16. log((1 + s) / (1 - s)) = 2 (s + s^3 / 3 + ...)
 * with |s| < 0.172; the first part of log(2) has 32 bits, so that its products with exponents are exact. */
static inline double natural_logarithm(double x)
{
    static const double c[12] = {1.0, 0.3333333333333333, 0.2, 0.14285714285714285, 0.1111111111111111, 0.09090909090909091,
        0.07692307692307693, 0.06666666666666667, 0.058823529411764705, 0.05263157894736842,
        0.047619047619047616, 0.043478260869565216};
    int exponent;
    double mantissa = frexp(x, &exponent);
    if (mantissa < 0.70710678118654752) {
        mantissa *= 2.0;
        exponent -= 1;
    }
    const double s = (mantissa - 1.0) / (mantissa + 1.0);
    return exponent * 0.6931471803691238 + (2.0 * s * horner(12, c, s * s) + exponent * 1.9082149292705877e-10);
}

/* exp(x) = value 2^exponent with 0.7 < value < 1.42, for |x| <= 1e15: no overflow; relative errors below 4e-16 |x| for
 * large |x|, where the rounding of x itself limits, and below 4e-16 for |x| < 700. Taylor series for |r| <= log(2) / 2;
 * the first part of log(2) has 32 bits, as above. */
static inline double exponential_parts(double x, Index *exponent)
{
    static const double c[15] = {1.0, 1.0, 0.5, 0.16666666666666666, 0.041666666666666664, 0.008333333333333333,
        0.001388888888888889, 0.0001984126984126984, 2.48015873015873e-05, 2.7557319223985893e-06,
        2.755731922398589e-07, 2.505210838544172e-08, 2.08767569878681e-09, 1.6059043836821613e-10,
        1.1470745597729725e-11};
    const double k = rint(x * 1.4426950408889634);
    const double r = (x - k * 0.6931471803691238) - k * 1.9082149292705877e-10;
    *exponent = (Index)k;
    return horner(15, c, r);
}

/* exp(x), 0 and infinity outside the range of float64; NaN for NaN. */
static inline double exponential_of(double x)
{
    Index exponent;
    if (x != x) return x;
    if (x > 709.8) return INFINITY;
    if (x < -745.2) return 0.0;
    const double value = exponential_parts(x, &exponent);
    return ldexp(value, (int)exponent);
}

/* x^(-1/7) of a positive number; relative errors below 3e-16. Newton's iteration from below. */
static inline double inverse_seventh_root(double x)
{
    int exponent;
    frexp(x, &exponent);
    double y = ldexp(1.0, -(exponent + (exponent > 0 ? 6 : 0)) / 7);
    for (int k = 0; k < 12; k++) {
        const double square = y * y, cube = square * y;
        y = y * (8.0 - x * (cube * cube * y)) / 7.0;
    }
    return y;
}

/* Quantile of the standard normal distribution; relative errors below 2e-15 (Wichura, Applied Statistics 37, 477, 1988,
 * algorithm AS 241: rational functions for the centre, the shoulders and the tails). */
static const double CENTRE[8] = {
    3.387132872796366608, 133.14166789178437745, 1971.5909503065514427, 13731.693765509461125,
    45921.953931549871457, 67265.770927008700853, 33430.575583588128105, 2509.0809287301226727};
static const double CENTRE_BELOW[8] = {
    1.0, 42.313330701600911252, 687.1870074920579083, 5394.1960214247511077, 21213.794301586595867,
    39307.89580009271061, 28729.085735721942674, 5226.495278852545925};
static const double SHOULDER[8] = {
    1.42343711074968357734, 4.6303378461565452959, 5.7694972214606914055, 3.64784832476320460504,
    1.27045825245236838258, 0.24178072517745061177, 0.0227238449892691845833, 7.7454501427834140764e-4};
static const double SHOULDER_BELOW[8] = {
    1.0, 2.05319162663775882187, 1.6763848301838038494, 0.68976733498510000455, 0.14810397642748007459,
    0.0151986665636164571966, 5.475938084995344946e-4, 1.05075007164441684324e-9};
static const double TAIL[8] = {
    6.6579046435011037772, 5.4637849111641143699, 1.7848265399172913358, 0.29656057182850489123,
    0.026532189526576123093, 0.0012426609473880784386, 2.71155556874348757815e-5, 2.01033439929228813265e-7};
static const double TAIL_BELOW[8] = {
    1.0, 0.59983220655588793769, 0.13692988092273580531, 0.0148753612908506148525, 7.868691311456132591e-4,
    1.8463183175100546818e-5, 1.4215117583164458887e-7, 2.04426310338993978564e-15};

static inline double quantile_of_normal(double p)
{
    const double q = p - 0.5, tail = p < 0.5 ? p : 1.0 - p;
    double r;
    if (fabs(q) <= 0.425) {
        r = 0.180625 - q * q;
        return q * (horner(8, CENTRE, r) / horner(8, CENTRE_BELOW, r));
    }
    if (!(tail > 0.0)) return copysign(tail == 0.0 ? INFINITY : NAN, q);
    r = sqrt(-natural_logarithm(tail));
    if (r <= 5.0)
        r = horner(8, SHOULDER, r - 1.6) / horner(8, SHOULDER_BELOW, r - 1.6);
    else
        r = horner(8, TAIL, r - 5.0) / horner(8, TAIL_BELOW, r - 5.0);
    return copysign(r, q);
}
