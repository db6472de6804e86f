"""Statistical filter (Meyer, Anderson 2006): device side of principal components of a sequence.

Frames are columns of a matrix D with a row a value, that is three rows a pixel. Columns come in blocks, four to a vec4;
a block is filled up with columns of zeros. Nothing depends on how the columns are cut into blocks.
"""

import warp as wp

wp.set_module_options({"enable_backward": False})

# Rows whose products are summed in float32 before the host goes on in float64.
STRIP = wp.constant(512)


@wp.kernel
def multiply_strips(
    offset: int,
    first: wp.array2d[wp.vec4],
    second: wp.array2d[wp.vec4],
    first_row: int,
    row_count: int,
    sums: wp.array3d[wp.mat44],
):
    """One thread multiplies four columns of `first` with four of `second` over one strip of rows: a piece of D^T D.

    Strips are counted from `first_row`; `sums` is indexed by strip, columns of `first`, columns of `second`.
    """
    tid = offset + wp.tid()
    columns = second.shape[1]
    b = tid % columns
    a = (tid // columns) % first.shape[1]
    strip = tid // (columns * first.shape[1])
    start = first_row + strip * STRIP
    total = wp.mat44(0.0)
    for row in range(start, wp.min(start + STRIP, first_row + row_count)):
        total = total + wp.outer(first[row, a], second[row, b])
    sums[strip, a, b] = total


@wp.kernel
def add_to_basis(
    offset: int,
    frames: wp.array2d[wp.vec4],
    weights: wp.array2d[wp.vec4],
    basis: wp.array2d[float],
    energy: wp.array[float],
):
    """One thread owns one row: adds a block's share of D V to `basis`, and of the row's squared length to `energy`.

    `weights` are the block's columns' parts in each basis function, shape (basis functions, columns / 4).
    """
    row = offset + wp.tid()
    squares = energy[row]
    for k in range(basis.shape[1]):
        total = basis[row, k]
        for c in range(frames.shape[1]):
            # one column after the other, or the sum would depend on the cut into blocks
            value = frames[row, c]
            weight = weights[k, c]
            for j in range(4):
                total = total + value[j] * weight[j]
        basis[row, k] = total
    for c in range(frames.shape[1]):
        value = frames[row, c]
        for j in range(4):
            squares = squares + value[j] * value[j]
    energy[row] = squares


@wp.kernel
def project(
    offset: int,
    basis: wp.array2d[float],
    weights: wp.array[float],
    truncation: wp.array[float],
    least: float,
    result: wp.array[wp.vec3],
):
    """One thread writes one pixel of one frame: the sum of the basis functions up to the pixel's truncation (eq. 3).

    Between whole numbers of basis functions it interpolates (sec. 3.2). Values below `least` become that.
    """
    i = offset + wp.tid()
    total = wp.vec3(0.0)
    for k in range(basis.shape[1]):
        part = wp.clamp(truncation[i] - float(k), 0.0, 1.0)
        if part == 0.0:
            break
        for c in range(3):
            total[c] = total[c] + part * weights[k] * basis[3 * i + c, k]
    result[i] = wp.max(total, wp.vec3(least))
