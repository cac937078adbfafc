/* Random numbers keyed by a seed and an index, the same as those of `IonRandom`: SplitMix64 (Steele, Lea and Flood,
 * OOPSLA 2014). */

#include <stdint.h>

static inline uint64_t mixed(uint64_t z)
{
    z = (z ^ (z >> 30)) * UINT64_C(0xBF58476D1CE4E5B9);
    z = (z ^ (z >> 27)) * UINT64_C(0x94D049BB133111EB);
    return z ^ (z >> 31);
}

/* Number j = 0, 1, ... of the stream with this index; uniform in (0, 1). */
static inline double uniform_number(uint64_t seed, uint64_t index, uint64_t j)
{
    const uint64_t gamma = UINT64_C(0x9E3779B97F4A7C15);
    const uint64_t state = mixed(mixed(seed + gamma) + (index + 1) * gamma);
    return ((double)(mixed(state + (j + 1) * gamma) >> 12) + 0.5) * 0x1p-52;
}
