"""Eight lanes at a time, for native code: which of them passed a test, as bits.

Tests run in plain loops over eight lanes, which a CPU's compiler turns into vector instructions and a GPU runs as they
are; only the step from a vector of answers to bits needs saying twice.
"""

#: Opens native code: `lane_mask` packs eight answers, 0 or 1, into bits; `next_lane` takes the lowest bit out;
#: `prefetch` asks for 64 numbers ahead of their use; `larger` and `smaller` are for numbers alone.
LANES_HEAD = """
#if defined(__CUDA_ARCH__)
    auto lane_mask = [](const int* met) {
        unsigned mask = 0u;
        for (int k = 0; k < 8; ++k)
            mask |= (unsigned)met[k] << k;
        return mask;
    };
    auto next_lane = [](unsigned& mask) {
        const int k = __ffs((int)mask) - 1;
        mask &= mask - 1u;
        return k;
    };
    auto prefetch = [](const float*) {};
#else
    auto prefetch = [](const float* p) {
        for (int k = 0; k < 64; k += 16)
            __builtin_prefetch(p + k);
    };
    typedef int lanes_of_int __attribute__((vector_size(32), aligned(4)));
    typedef bool lanes_of_bool __attribute__((ext_vector_type(8)));
    auto lane_mask = [](const int* met) {
        const lanes_of_int answers = *(const lanes_of_int*)met;
        return (unsigned)__builtin_bit_cast(unsigned char, __builtin_convertvector(answers != 0, lanes_of_bool));
    };
    auto next_lane = [](unsigned& mask) {
        const int k = __builtin_ctz(mask);
        mask &= mask - 1u;
        return k;
    };
#endif
    // one instruction each; Warp's heed NaN and take three
    auto larger = [](float a, float b) { return a > b ? a : b; };
    auto smaller = [](float a, float b) { return a < b ? a : b; };
"""

# Native code that walks a splat tree to the blocks whose boxes hold the point x; what follows does something with
# `block`, whose numbers are at `p`, and closes two braces.
POINT_WALK = (
    LANES_HEAD
    + """
    int stack[128];
    int top = 1;
    stack[0] = 0;
    while (top > 0) {
        const int current = stack[--top];
        if (current >= 0) {
            const float* p = tree.nodes.data + (size_t)current * 48;
            int met[8];
            for (int k = 0; k < 8; ++k)
                met[k] = (int)((x[0] >= p[k]) & (x[1] >= p[8 + k]) & (x[2] >= p[16 + k]) & (x[0] <= p[24 + k]) &
                               (x[1] <= p[32 + k]) & (x[2] <= p[40 + k]));
            const int first = tree.first.data[current];
            unsigned mask = lane_mask(met);
            while (mask) {
                const int k = next_lane(mask);
                stack[top++] = first >= 0 ? first + k : first - k;
            }
        } else {
            const int block = -1 - current;
            const float* p = tree.blocks.data + (size_t)block * 80;
"""
)
