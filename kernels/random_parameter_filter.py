"""Random parameter filtering (Sen, Darabi 2012; details in Sen, Darabi 2011, UNM EECE-TR-11-0004): device side.

The columns of a sample: 3 of colour, 12 features (primary position and normal, secondary position and normal), then 2
random parameters and 2 of screen position.
"""

import warp as wp

from warpgi.kernels.rng import INDEPENDENT, make_sampler, sample_2d

wp.set_module_options({"enable_backward": False})

COLORS = wp.constant(3)
FEATURES = wp.constant(12)
RANDOM = wp.constant(15)  # first column of the random parameters, two of them
SCREEN = wp.constant(17)  # first column of the screen position, two of them
COLUMNS = wp.constant(19)
OUTPUTS = wp.constant(15)  # colours and features: what depends on random parameters and screen position

BINS = wp.constant(5)  # over two standard deviations to either side

# Neighbours may differ from a pixel's mean by so many of the pixel's standard deviations ...
POSITION_SIGMAS = wp.constant(30.0)
NORMAL_SIGMAS = wp.constant(3.0)
# ... and, where a pixel shows hardly any, by this part of the whole picture's.
LEAST_SPREAD = wp.constant(0.1)

# A column that varies by less than this part of its spread over the whole picture is constant, but for rounding.
CONSTANT = wp.constant(1.0e-4)

vec19 = wp.types.vector(length=19, dtype=wp.float32)
vec25i = wp.types.vector(length=25, dtype=wp.int32)


@wp.struct
class Samples:
    width: int
    height: int
    first: wp.array[int]  # a pixel's first sample; one entry more than pixels
    pixel: wp.array[int]  # of each sample
    primary: wp.array[int]  # 1: has a primary hit
    known: wp.array[int]  # 1: and a colour
    position: wp.array[wp.vec3]
    normal: wp.array[wp.vec3]
    hit: wp.array[wp.vec3]
    hit_normal: wp.array[wp.vec3]
    parameters: wp.array[wp.vec4]  # two random parameters, screen position
    spread: vec19  # standard deviation of each column over the picture, alike for x, y and z


@wp.struct
class Neighbourhoods:
    """Of a run of pixels; `size` is the most samples that one can have."""

    first_pixel: int
    size: int
    count: wp.array[int]
    sample: wp.array[int]  # [pixel, number]
    mean: wp.array[vec19]
    inverse_sigma: wp.array[vec19]  # 0 for a constant column
    bins: wp.array[wp.uint8]  # [pixel, column, number]
    dependency: wp.array[wp.vec3]  # [pixel, output]: on random parameters, on screen position, of the colours on it


@wp.func
def columns(samples: Samples, color: wp.array[wp.vec3], j: int):
    c = color[j]
    p = samples.position[j]
    n = samples.normal[j]
    h = samples.hit[j]
    m = samples.hit_normal[j]
    q = samples.parameters[j]
    return vec19(
        c[0], c[1], c[2], p[0], p[1], p[2], n[0], n[1], n[2], h[0], h[1], h[2], m[0], m[1], m[2], q[0], q[1], q[2], q[3]
    )  # fmt: skip


@wp.func
def tolerance(sigma: vec19, spread: vec19, count: int):
    """How far from its pixel's mean a feature of a neighbour may lie."""
    result = vec19()
    for k in range(COLORS, COLORS + FEATURES):
        group = (k - COLORS) // 3
        sigmas = wp.where(group % 2 == 0, POSITION_SIGMAS, NORMAL_SIGMAS)
        result[k] = wp.max(sigmas * sigma[k], LEAST_SPREAD * spread[k])
        if count < 2 and group >= 2:
            result[k] = 1.0e30  # one secondary hit says nothing of where others would be
    return result


@wp.func
def is_alike(v: vec19, mean: vec19, limit: vec19):
    for k in range(COLORS, COLORS + FEATURES):
        if wp.abs(v[k] - mean[k]) > limit[k]:
            return False
    return True


@wp.kernel
def choose_neighbours(
    offset: int,
    samples: Samples,
    color: wp.array[wp.vec3],
    box: int,
    round: int,
    draws: int,
    seed: int,
    found: Neighbourhoods,
):
    """One thread fills one pixel's neighbourhood: its own samples, then what `draws` Gaussian draws from the box hit.

    Also mean and standard deviation of its columns. Sums are of differences from the first sample, so that equal values
    have no deviation at all.
    """
    i = offset + wp.tid()
    pixel = found.first_pixel + i
    begin = samples.first[pixel]
    end = samples.first[pixel + 1]
    start = i * found.size
    count = int(0)
    base = vec19()
    total = vec19()
    squares = vec19()
    for j in range(begin, end):
        if samples.known[j] != 0:
            v = columns(samples, color, j)
            if count == 0:
                base = v
            d = v - base
            total = total + d
            squares = squares + wp.cw_mul(d, d)
            found.sample[start + count] = j
            count = count + 1
    found.count[i] = count
    if count == 0:
        return
    own = 1.0 / float(count)
    mean = total * own
    sigma = vec19()
    for k in range(COLUMNS):
        sigma[k] = wp.sqrt(wp.max(0.0, squares[k] * own - mean[k] * mean[k]))
    limit = tolerance(sigma, samples.spread, count)
    mean = mean + base
    for m in range(draws):
        s = make_sampler(seed, pixel, m, INDEPENDENT)
        u = sample_2d(s, 2 * round)
        choice = sample_2d(s, 2 * round + 1)
        # Box, Muller 1958; sigma is a quarter of the box
        r = 0.25 * float(box) * wp.sqrt(-2.0 * wp.log(1.0 - u[0]))
        dx = int(wp.round(r * wp.cos(2.0 * wp.pi * u[1])))
        dy = int(wp.round(r * wp.sin(2.0 * wp.pi * u[1])))
        x = pixel % samples.width + dx
        y = pixel // samples.width + dy
        outside = x < 0 or y < 0 or x >= samples.width or y >= samples.height or (dx == 0 and dy == 0)
        if outside or 2 * wp.max(wp.abs(dx), wp.abs(dy)) > box:
            continue
        q = y * samples.width + x
        there = samples.first[q + 1] - samples.first[q]
        if there == 0:
            continue
        j = samples.first[q] + wp.min(int(choice[0] * float(there)), there - 1)
        if samples.known[j] == 0:
            continue
        v = columns(samples, color, j)
        if is_alike(v, mean, limit):
            d = v - base
            total = total + d
            squares = squares + wp.cw_mul(d, d)
            found.sample[start + count] = j
            count = count + 1
    found.count[i] = count
    part = 1.0 / float(count)
    mean = total * part
    inverse = vec19()
    for k in range(COLUMNS):
        deviation = wp.sqrt(wp.max(0.0, squares[k] * part - mean[k] * mean[k]))
        if deviation > CONSTANT * samples.spread[k]:
            inverse[k] = 1.0 / deviation
    found.mean[i] = mean + base
    found.inverse_sigma[i] = inverse


@wp.kernel
def quantise(offset: int, samples: Samples, color: wp.array[wp.vec3], found: Neighbourhoods):
    """One thread sorts one pixel's neighbourhood into bins, each column by itself."""
    i = offset + wp.tid()
    if found.count[i] == 0:
        return
    mean = found.mean[i]
    inverse = found.inverse_sigma[i]
    for m in range(found.count[i]):
        v = wp.cw_mul(columns(samples, color, found.sample[i * found.size + m]) - mean, inverse)
        for k in range(COLUMNS):
            at = wp.clamp(wp.round(0.25 * (v[k] + 2.0) * float(BINS - 1)), 0.0, float(BINS - 1))
            found.bins[(i * COLUMNS + k) * found.size + m] = wp.uint8(at)


@wp.func
def mutual_information(bins: wp.array[wp.uint8], a: int, b: int, count: int):
    """Sum of p(a, b) log(p(a, b) / (p(a) p(b))) over the bins, of two columns that start at a and b.

    Less what chance gives independent columns (Miller 1955): with hundreds of samples for the paper's thousands, that
    would pass for a dependency.
    """
    joint = vec25i()
    for m in range(count):
        cell = int(bins[a + m]) * BINS + int(bins[b + m])
        joint[cell] = joint[cell] + 1
    share = 1.0 / float(count)
    result = float(0.0)
    rows = int(0)
    for x in range(BINS):
        row = int(0)
        for y in range(BINS):
            row = row + joint[x * BINS + y]
        if row > 0:
            rows = rows + 1
            for y in range(BINS):
                n = joint[x * BINS + y]
                if n > 0:
                    column = int(0)
                    for z in range(BINS):
                        column = column + joint[z * BINS + y]
                    p = float(n) * share
                    result = result + p * wp.log(p / (float(row) * share * float(column) * share))
    used = int(0)
    for y in range(BINS):
        column = int(0)
        for z in range(BINS):
            column = column + joint[z * BINS + y]
        if column > 0:
            used = used + 1
    return wp.max(0.0, result - 0.5 * share * float((rows - 1) * (used - 1)))


@wp.kernel
def measure_dependency(offset: int, found: Neighbourhoods):
    """One thread measures one output of one pixel: a colour channel's or a feature's dependencies."""
    t = offset + wp.tid()
    i = t // OUTPUTS
    k = t % OUTPUTS
    count = found.count[i]
    result = wp.vec3(0.0)
    if count > 0 and found.inverse_sigma[i][k] > 0.0:
        start = i * COLUMNS
        mine = (start + k) * found.size
        for c in range(2):
            random = mutual_information(found.bins, mine, (start + RANDOM + c) * found.size, count)
            screen = mutual_information(found.bins, mine, (start + SCREEN + c) * found.size, count)
            result = result + wp.vec3(random, screen, 0.0)
        if k >= COLORS:
            for c in range(COLORS):
                color = mutual_information(found.bins, mine, (start + c) * found.size, count)
                result = result + wp.vec3(0.0, 0.0, color)
    found.dependency[t] = result


@wp.func
def share_of(a: float, b: float):
    """a / (a + b), 0 where nothing depends on anything."""
    return wp.where(a > 0.0, a / (a + b + 1.0e-10), 0.0)


@wp.kernel
def filter_samples(
    offset: int,
    first_sample: int,
    samples: Samples,
    color: wp.array[wp.vec3],
    found: Neighbourhoods,
    growth: float,
    scale: float,
    filtered: wp.array[wp.vec3],
    filled: wp.array[int],
):
    """One thread filters one sample's colour by those of its pixel's neighbourhood.

    `growth` is 1 + 0.1 per round before this one, `scale` spp / (16 sigma_8^2). A sample whose own colour is not known
    takes what neighbours at places like its own have; `filled` says whether there were any.
    """
    row = first_sample + offset + wp.tid()
    i = samples.pixel[row] - found.first_pixel
    count = found.count[i]
    here = color[row]
    has_color = samples.known[row] != 0
    filtered[row] = here
    filled[row] = samples.known[row]
    if samples.primary[row] == 0 or count == 0:
        return
    # dependencies of the colours: on random parameters, screen position, features
    at = i * OUTPUTS
    on_random = float(0.0)
    on_screen = float(0.0)
    on_features = float(0.0)
    for k in range(OUTPUTS):
        d = found.dependency[at + k]
        if k < COLORS:
            on_random = on_random + d[0]
            on_screen = on_screen + d[1]
        on_features = on_features + d[2]
    by_random = share_of(on_random, on_screen)
    narrow = scale * (1.0 - by_random) * (1.0 - by_random)
    inverse = found.inverse_sigma[i]
    weights = vec19()  # of squared differences
    for k in range(OUTPUTS):
        d = found.dependency[at + k]
        squared = inverse[k] * inverse[k] * narrow
        if k < COLORS:
            # one weight for all channels, or hues would shift
            if has_color:
                weights[k] = squared * wp.max(0.0, 1.0 - growth * by_random)
        elif has_color or k < 9:
            by_feature = share_of(d[2], on_random + on_screen + on_features - d[2])
            weights[k] = squared * by_feature * wp.max(0.0, 1.0 - growth * share_of(d[0], d[1]))
    mine = columns(samples, color, row)
    base = wp.where(has_color, here, wp.vec3(0.0))
    total = wp.vec3(0.0)
    weight = float(0.0)
    for m in range(count):
        j = found.sample[i * found.size + m]
        away = columns(samples, color, j) - mine
        w = wp.exp(-wp.dot(wp.cw_mul(away, away), weights))
        total = total + (color[j] - base) * w
        weight = weight + w
    if weight > 0.0:
        filtered[row] = base + total / weight
        filled[row] = 1


@wp.func
def luminance(c: wp.vec3):
    return 0.2126 * c[0] + 0.7152 * c[1] + 0.0722 * c[2]


@wp.kernel
def clamp_outliers(offset: int, first_pixel: int, samples: Samples, reinsert: int, filtered: wp.array[wp.vec3]):
    """One thread puts the samples of one pixel that differ by more than one standard deviation to the pixel's mean.

    Sen, Darabi 2011: "HDR clamp", here by luminance, or hues would shift. With `reinsert` the light that this loses is
    given back evenly to all samples of the pixel (Lehtinen et al. 2012, section 3.1).
    """
    pixel = first_pixel + offset + wp.tid()
    begin = samples.first[pixel]
    end = samples.first[pixel + 1]
    count = float(0.0)
    base = wp.vec3(0.0)
    total = wp.vec3(0.0)
    squares = float(0.0)
    for j in range(begin, end):
        if samples.known[j] != 0:
            if count == 0.0:
                base = filtered[j]
            d = filtered[j] - base
            total = total + d
            squares = squares + luminance(d) * luminance(d)
            count = count + 1.0
    if count < 2.0:
        return
    mean = base + total / count
    away = luminance(total / count)
    sigma = wp.sqrt(wp.max(0.0, squares / count - away * away))
    lost = wp.vec3(0.0)
    for j in range(begin, end):
        if samples.known[j] != 0 and wp.abs(luminance(filtered[j] - mean)) > sigma:
            lost = lost + (filtered[j] - mean)
            filtered[j] = mean
    if reinsert != 0:
        for j in range(begin, end):
            if samples.known[j] != 0:
                filtered[j] = filtered[j] + lost / count
