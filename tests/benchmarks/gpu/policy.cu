// Perturbed policies on a GPU: INPUTS inputs, two hidden layers of 256 units and OUTPUTS outputs, tanh after each.
//
// The weights of the members of pair p are centre +- unit k_p, k = 2 j + 1, with the bits of
// workers/simd/episodes/check.py: every sum begins with the bias and adds its products in the order of the inputs,
// each rounded once; the weights of + are (centre + unit) + 2 unit j, those of - in hidden layers 2 centre minus that
// weight, and in the last layer (centre - unit) - 2 unit j. Compile with -ftz=true -fmad=false.
//
// Bytes j + 128 of the noise of a pair, whose coordinates artefacts.py lists in this order:
//     each hidden layer   [input / 4, output / 4, input % 4, output % 4], then biases [output]
//     last layer          [output, input], then biases [output]
// Floats of the centre: hidden layers [input, output], biases [output]; last layer [output, input], biases [output].
//
// A thread computes four neighbouring outputs of both members of PAIRS pairs, 64 threads a hidden layer, and a block of
// 256 threads has 4 * PAIRS pairs, which read the same row of the centre at about the same time.

#include <stdint.h>

constexpr int WIDTH = 256, QUADS = WIDTH / 4, THREADS = 256, GROUPS = THREADS / QUADS;
constexpr int STRIDE = WIDTH + 4;                    // of activations in shared memory, so that banks differ
constexpr int DEPTH = 4;                             // noise is loaded so many groups of four inputs ahead
__host__ __device__ constexpr int groups_of(int inputs) { return (inputs + 3) / 4; }
__host__ __device__ constexpr int noise_of(int inputs) { return groups_of(inputs) * 4 * WIDTH + WIDTH; }
constexpr int SECOND = noise_of(INPUTS), LAST = SECOND + noise_of(WIDTH);
constexpr int NOISE = (LAST + OUTPUTS * WIDTH + OUTPUTS + 127) / 128 * 128;
constexpr int CENTRE_2 = (INPUTS + 1) * WIDTH, CENTRE_3 = CENTRE_2 + (WIDTH + 1) * WIDTH;

// The noise j in byte `place` of a word: the difference of 2^23 + byte, which needs no conversion, and 2^23 + 128.
__device__ __forceinline__ float noise(uint32_t word, int place, uint32_t two_to_23) {
    return __fadd_rn(__uint_as_float(__byte_perm(word, two_to_23, 0x7440 | place)), -8388736.0f);
}

__device__ __forceinline__ uint32_t word_of(const uint4& words, int k) {
    return k == 0 ? words.x : k == 1 ? words.y : k == 2 ? words.z : words.w;
}

__device__ __forceinline__ float part_of(const float4& four, int k) {
    return k == 0 ? four.x : k == 1 ? four.y : k == 2 ? four.z : four.w;
}

__device__ __forceinline__ float clipped(float x, float most) {
    x = most < x ? most : x;
    return x < -most ? -most : x;
}

// workers/simd/graph/elementary.py: tanh
__device__ __forceinline__ float tanh_of(float x) {
    const float bounded = clipped(x, 9.0f), square = __fmul_rn(bounded, bounded);
    float above = TANH_ABOVE_4, below = TANH_BELOW_4;
    above = __fmaf_rn(above, square, TANH_ABOVE_3), below = __fmaf_rn(below, square, TANH_BELOW_3);
    above = __fmaf_rn(above, square, TANH_ABOVE_2), below = __fmaf_rn(below, square, TANH_BELOW_2);
    above = __fmaf_rn(above, square, TANH_ABOVE_1), below = __fmaf_rn(below, square, TANH_BELOW_1);
    above = __fmaf_rn(above, square, TANH_ABOVE_0), below = __fmaf_rn(below, square, TANH_BELOW_0);
    return clipped(__fdiv_rn(__fmul_rn(bounded, above), below), 1.0f);
}

// Add the products of one input, or of the bias with x = 1, to the sums [pair, member, output].
template <int PAIRS, bool BIAS>
__device__ __forceinline__ void add(float (&sums)[PAIRS][2][4], const float4& centre, const uint32_t (&words)[PAIRS],
                                    const float (&x)[PAIRS][2], float unit, float twice, uint32_t two_to_23) {
#pragma unroll
    for (int o = 0; o < 4; o++) {
        const float c = part_of(centre, o), moved = __fadd_rn(c, unit), doubled = __fadd_rn(c, c);
#pragma unroll
        for (int p = 0; p < PAIRS; p++) {
            const float plus = __fmaf_rn(noise(words[p], o, two_to_23), twice, moved), minus = __fsub_rn(doubled, plus);
            sums[p][0][o] = BIAS ? plus : __fmaf_rn(x[p][0], plus, sums[p][0][o]);
            sums[p][1][o] = BIAS ? minus : __fmaf_rn(x[p][1], minus, sums[p][1][o]);
        }
    }
}

// A hidden layer of PAIRS pairs, four outputs of a thread; x [pair, member, STRIDE] in shared memory becomes them.
template <int ROWS, int PAIRS>
__device__ __forceinline__ void hidden(const uint8_t* const (&bytes)[PAIRS], const float* centre, float* x,
                                       float unit, float twice, uint32_t two_to_23, int quad) {
    constexpr int WHOLE = ROWS / 4, ALL = groups_of(ROWS);
    const float4* rows = reinterpret_cast<const float4*>(centre) + quad;
    float sums[PAIRS][2][4], seen[PAIRS][2];
    uint32_t words[PAIRS];
    uint4 ahead[DEPTH][PAIRS];
#pragma unroll
    for (int d = 0; d < DEPTH; d++)
#pragma unroll
        for (int p = 0; p < PAIRS; p++)
            ahead[d][p] = __ldcs(reinterpret_cast<const uint4*>(bytes[p]) + min(d, ALL - 1) * QUADS + quad);
#pragma unroll
    for (int p = 0; p < PAIRS; p++)
        words[p] = __ldcs(reinterpret_cast<const uint32_t*>(bytes[p] + ALL * 4 * WIDTH) + quad);
    float4 next = __ldg(rows);
    add<PAIRS, true>(sums, __ldg(rows + ROWS * QUADS), words, seen, unit, twice, two_to_23);

#pragma unroll 1
    for (int first = 0; first < WHOLE; first += DEPTH) {
#pragma unroll
        for (int d = 0; d < DEPTH; d++) {
            const int group = first + d;
            if (group < WHOLE) {
                float4 four[PAIRS][2];
#pragma unroll
                for (int p = 0; p < PAIRS; p++)
#pragma unroll
                    for (int m = 0; m < 2; m++)
                        four[p][m] = reinterpret_cast<const float4*>(x + (2 * p + m) * STRIDE)[group];
#pragma unroll
                for (int r = 0; r < 4; r++) {
                    const float4 now = next;
                    next = __ldg(rows + min(4 * group + r + 1, ROWS - 1) * QUADS);
#pragma unroll
                    for (int p = 0; p < PAIRS; p++) {
                        words[p] = word_of(ahead[d][p], r);
                        seen[p][0] = part_of(four[p][0], r), seen[p][1] = part_of(four[p][1], r);
                    }
                    add<PAIRS, false>(sums, now, words, seen, unit, twice, two_to_23);
                }
#pragma unroll
                for (int p = 0; p < PAIRS; p++)
                    ahead[d][p] = __ldcs(reinterpret_cast<const uint4*>(bytes[p]) +
                                         min(group + DEPTH, ALL - 1) * QUADS + quad);
            }
        }
    }
#pragma unroll
    for (int r = 0; r < ROWS % 4; r++) {
        const float4 now = next;
        next = __ldg(rows + min(4 * WHOLE + r + 1, ROWS - 1) * QUADS);
#pragma unroll
        for (int p = 0; p < PAIRS; p++) {
            words[p] = word_of(ahead[WHOLE % DEPTH][p], r);
            seen[p][0] = x[(2 * p) * STRIDE + 4 * WHOLE + r], seen[p][1] = x[(2 * p + 1) * STRIDE + 4 * WHOLE + r];
        }
        add<PAIRS, false>(sums, now, words, seen, unit, twice, two_to_23);
    }
    __syncthreads();  // all have read x
#pragma unroll
    for (int p = 0; p < PAIRS; p++)
#pragma unroll
        for (int m = 0; m < 2; m++)
            reinterpret_cast<float4*>(x + (2 * p + m) * STRIDE)[quad] =
                make_float4(tanh_of(sums[p][m][0]), tanh_of(sums[p][m][1]), tanh_of(sums[p][m][2]),
                            tanh_of(sums[p][m][3]));
    __syncthreads();
}

// One output of one member, from x in shared memory.
__device__ __forceinline__ float last(const uint8_t* bytes, const float* centre, const float* x, float unit,
                                      uint32_t two_to_23, int output) {
    const float twice = __fadd_rn(unit, unit);
    const uint4* noises = reinterpret_cast<const uint4*>(bytes + output * WIDTH);
    const float4* weights = reinterpret_cast<const float4*>(centre + output * WIDTH);
    const uint32_t bias = bytes[OUTPUTS * WIDTH + output];
    float sum = __fmaf_rn(noise(bias, 0, two_to_23), twice, __fadd_rn(__ldg(centre + OUTPUTS * WIDTH + output), unit));
    uint4 ahead[DEPTH];
#pragma unroll
    for (int d = 0; d < DEPTH; d++) ahead[d] = __ldcs(noises + d);
#pragma unroll 1
    for (int first = 0; first < WIDTH / 16; first += DEPTH) {
#pragma unroll
        for (int d = 0; d < DEPTH; d++) {
            const uint4 now = ahead[d];
            ahead[d] = __ldcs(noises + min(first + d + DEPTH, WIDTH / 16 - 1));
#pragma unroll
            for (int k = 0; k < 4; k++) {
                const int place = (first + d) * 4 + k;
                const float4 c = __ldg(weights + place), seen = reinterpret_cast<const float4*>(x)[place];
#pragma unroll
                for (int r = 0; r < 4; r++) {
                    const float moved = __fadd_rn(part_of(c, r), unit);
                    const float weight = __fmaf_rn(noise(word_of(now, k), r, two_to_23), twice, moved);
                    sum = __fmaf_rn(part_of(seen, r), weight, sum);
                }
            }
        }
    }
    return tanh_of(sum);
}

// Actions [output, member] of observations [input, member]; members 2 p and 2 p + 1 are + and - of pair p.
template <int PAIRS>
__device__ __forceinline__ void policy(const float* seen, const uint8_t* noises, const float* centre, float* action,
                                       float unit, int pairs) {
    constexpr int OF_BLOCK = GROUPS * PAIRS;
    __shared__ __align__(16) float x[OF_BLOCK * 2 * STRIDE];
    const int thread = threadIdx.x, group = thread / QUADS, quad = thread % QUADS, start = blockIdx.x * OF_BLOCK;
    const float twice = __fadd_rn(unit, unit);
    // The bits of 2^23, as a value that the compiler keeps in a register instead of making it anew for each byte.
    const uint32_t two_to_23 = 0x4B000000u | ((uint32_t)pairs >> 31);
    for (int place = thread; place < INPUTS * OF_BLOCK * 2; place += THREADS) {
        const int member = place % (OF_BLOCK * 2), input = place / (OF_BLOCK * 2);
        x[member * STRIDE + input] = seen[(int64_t)input * 2 * pairs + min(2 * start + member, 2 * pairs - 1)];
    }
    __syncthreads();
    const uint8_t* bytes[PAIRS];
#pragma unroll
    for (int p = 0; p < PAIRS; p++) bytes[p] = noises + (int64_t)min(start + group * PAIRS + p, pairs - 1) * NOISE;
    float* mine = x + group * PAIRS * 2 * STRIDE;
    hidden<INPUTS, PAIRS>(bytes, centre, mine, unit, twice, two_to_23, quad);
#pragma unroll
    for (int p = 0; p < PAIRS; p++) bytes[p] += SECOND;
    hidden<WIDTH, PAIRS>(bytes, centre + CENTRE_2, mine, unit, twice, two_to_23, quad);
    for (int place = thread; place < OF_BLOCK * 2 * OUTPUTS; place += THREADS) {
        const int output = place % OUTPUTS, member = place / OUTPUTS, pair = start + member / 2;
        if (pair < pairs)
            action[(int64_t)output * 2 * pairs + 2 * start + member] =
                last(noises + (int64_t)pair * NOISE + LAST, centre + CENTRE_3, x + member * STRIDE,
                     member % 2 ? -unit : unit, two_to_23, output);
    }
}

#define POLICY(PAIRS, BLOCKS)                                                                                      \
    extern "C" __global__ void __launch_bounds__(THREADS, BLOCKS) policy_##PAIRS##_##BLOCKS(                       \
        const float* __restrict__ seen, const uint8_t* __restrict__ noises, const float* __restrict__ centre,      \
        float* __restrict__ action, float unit, int pairs) {                                                       \
        policy<PAIRS>(seen, noises, centre, action, unit, pairs);                                                  \
    }
POLICY(1, 2)
POLICY(1, 4)
POLICY(2, 2)
POLICY(2, 3)
POLICY(4, 1)

// es_service/protocol/noise.py: normal_integers; bytes j + 128 of each pair [pair, NOISE].
extern "C" __global__ void fill(const uint32_t* __restrict__ keys, const uint32_t* __restrict__ coordinates,
                                uint8_t* __restrict__ noises) {
    const int place = blockIdx.x * blockDim.x + threadIdx.x, pair = blockIdx.y;
    if (place >= NOISE) return;
    const uint32_t* key = keys + 4 * pair;
    uint32_t x = coordinates[place] * 0x9E3779B9u + key[0];
    x = ((x ^ (x >> 16)) * 0x21F0AAADu) ^ key[1];
    x = (x ^ (x >> 15)) * 0xD35A2D97u;
    x = x ^ (x >> 15);
    uint32_t y = (x + key[2]) * 0x85EBCA6Bu;
    y = ((y ^ (y >> 15)) * 0xC2B2AE35u) ^ key[3];
    y = (y ^ (y >> 16)) * 0x21F0AAADu;
    y = y ^ (y >> 15);
    noises[(int64_t)pair * NOISE + place] = (uint8_t)(4 * (__popc(x) + __popc(y >> 2)) + (y & 3) + 2);
}
