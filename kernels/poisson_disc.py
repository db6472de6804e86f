"""Poisson-disc subsets of points on surfaces: dart throwing in cells (Wei 2008), device side."""

import warp as wp

wp.set_module_options({"enable_backward": False})

# Of distances along a normal: |d|^2 + 8 (d.n)^2 counts them threefold, as the sizing of splats does.
STRETCH = wp.constant(8.0)


@wp.func
def disc_distance2(d: wp.vec3, n: wp.vec3, m: wp.vec3):
    """Squared distance of two points of surfaces with normals n and m, farther apart off each other's planes."""
    a = wp.dot(d, n)
    b = wp.dot(d, m)
    return wp.dot(d, d) + STRETCH * wp.max(a * a, b * b)


@wp.kernel
def throw_darts(
    offset: int,
    cells: wp.array[int],
    first: wp.array[int],
    neighbours: wp.array2d[int],
    position: wp.array[wp.vec3],
    normal: wp.array[wp.vec3],
    radius2: float,
    cosine: float,
    taken: wp.array[int],
    count: wp.array[int],
):
    """One thread owns one cell and takes its points in their order, each unless one that was taken lies too near.

    Cells are as wide as the discs' radius, and no two of a launch are neighbours: what a thread reads is written by no
    other. `taken` lists, from the cell's `first` place on, `count` places of points; some may be there before.
    """
    c = cells[offset + wp.tid()]
    for k in range(first[c] + count[c], first[c + 1]):
        free = int(1)
        for j in range(27):
            b = neighbours[c, j]
            if b >= 0 and free == 1:
                for i in range(count[b]):
                    q = taken[first[b] + i]
                    if wp.dot(normal[k], normal[q]) > cosine:
                        if disc_distance2(position[k] - position[q], normal[k], normal[q]) < radius2:
                            free = 0
                            break
        if free == 1:
            taken[first[c] + count[c]] = k
            count[c] = count[c] + 1
