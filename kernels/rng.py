"""Random numbers keyed by (seed, pixel, sample, dimension): independent, or Owen-scrambled Sobol.

A number is a pure function of its key, so a picture does not depend on threads, chunks or passes. Each call gives
two numbers for one `dimension`, a pair such as "where on the light" that a path numbers by itself.
"""

import warp as wp

wp.set_module_options({"enable_backward": False})

INDEPENDENT = wp.constant(0)
SOBOL = wp.constant(1)

# Pairs of dimensions up to here are stratified by the Sobol sequence; what lies deeper in a path gains nothing by it.
SOBOL_PAIRS = wp.constant(24)

GOLDEN_GAMMA = wp.constant(wp.uint64(0x9E3779B97F4A7C15))
MIX_A = wp.constant(wp.uint64(0xBF58476D1CE4E5B9))
MIX_B = wp.constant(wp.uint64(0x94D049BB133111EB))
OWEN_A = wp.constant(wp.uint32(0x6C50B47C))
OWEN_B = wp.constant(wp.uint32(0xB82F1E52))
OWEN_C = wp.constant(wp.uint32(0xC7AFE638))
OWEN_D = wp.constant(wp.uint32(0x8D22F6E6))
TO_UNIT = wp.constant(1.0 / 16777216.0)  # 24 bits, so that the largest result stays below 1


@wp.struct
class Sampler:
    key: wp.uint64  # of (seed, pixel, sample): the independent stream
    pixel_key: wp.uint64  # of (seed, pixel): the scrambling
    index: wp.uint32  # sample number, bits reversed
    mode: int  # INDEPENDENT or SOBOL


@wp.func
def mix64(value: wp.uint64):
    """Finaliser of SplitMix64 (Steele, Lea, Flood 2014): a bijection with full avalanche."""
    z = (value ^ (value >> wp.uint64(30))) * MIX_A
    z = (z ^ (z >> wp.uint64(27))) * MIX_B
    return z ^ (z >> wp.uint64(31))


@wp.func
def to_unit(bits: wp.uint32):
    return float(bits >> wp.uint32(8)) * TO_UNIT


@wp.func_native("""
#if defined(__CUDA_ARCH__)
    return __brev(value);
#else
    return __builtin_bitreverse32(value);
#endif
""")
def reverse_bits(value: wp.uint32) -> wp.uint32: ...


@wp.func
def laine_karras(value: wp.uint32, seed: wp.uint32):
    """Owen scrambling of a number whose bits are reversed (Laine, Karras 2011, constants of Burley 2020)."""
    x = value + seed
    x = x ^ (x * OWEN_A)
    x = x ^ (x * OWEN_B)
    x = x ^ (x * OWEN_C)
    return x ^ (x * OWEN_D)


@wp.func
def sobol_second(index: wp.uint32):
    """Second Sobol dimension, bits reversed: Pascal's triangle modulo 2 as five butterflies."""
    x = index
    x = x ^ ((x >> wp.uint32(1)) & wp.uint32(0x55555555))
    x = x ^ ((x >> wp.uint32(2)) & wp.uint32(0x33333333))
    x = x ^ ((x >> wp.uint32(4)) & wp.uint32(0x0F0F0F0F))
    x = x ^ ((x >> wp.uint32(8)) & wp.uint32(0x00FF00FF))
    return x ^ (x >> wp.uint32(16))


@wp.func
def make_sampler(seed: int, pixel: int, sample: int, mode: int):
    s = Sampler()
    s.pixel_key = mix64(mix64(wp.uint64(seed) + GOLDEN_GAMMA) ^ wp.uint64(pixel))
    s.key = mix64(s.pixel_key ^ (wp.uint64(sample) * GOLDEN_GAMMA))
    s.index = reverse_bits(wp.uint32(sample))
    s.mode = mode
    return s


@wp.func
def sample_2d(s: Sampler, dimension: int):
    """Two numbers in [0, 1) for pair `dimension` of this sample."""
    if s.mode == SOBOL and dimension < SOBOL_PAIRS:
        # Padded pairs of the first two Sobol dimensions, index shuffled and values scrambled (Burley 2020).
        bits = mix64(s.pixel_key + wp.uint64(dimension + 1) * GOLDEN_GAMMA)
        low = wp.uint32(bits)
        high = wp.uint32(bits >> wp.uint64(32))
        index = reverse_bits(laine_karras(s.index, low ^ (high * OWEN_B)))
        x = laine_karras(index, low)
        y = laine_karras(sobol_second(index), high)
        return wp.vec2(to_unit(reverse_bits(x)), to_unit(reverse_bits(y)))
    bits = mix64(s.key + wp.uint64(dimension + 1) * GOLDEN_GAMMA)
    return wp.vec2(to_unit(wp.uint32(bits)), to_unit(wp.uint32(bits >> wp.uint64(32))))
