"""Makes the wide triangle tree out of the binary one that `wp.Mesh` builds by the surface area heuristic.

Runs on the CPU, where Warp builds such trees for every device.
"""

import warp as wp

from warpgi.kernels.triangles import BLOCK_FLOATS, NODE_FLOATS, WIDTH

wp.set_module_options({"enable_backward": False})

BOX_ROWS = wp.constant(6)
LANES = wp.constant(WIDTH)
NODE_STRIDE = wp.constant(NODE_FLOATS)
BLOCK_STRIDE = wp.constant(BLOCK_FLOATS)
# Boxes grow by this part of their largest coordinate, so that a ray in the plane of a side is inside.
BOX_MARGIN = wp.constant(2.4e-7)


@wp.struct
class BinaryTree:
    lower: wp.array[wp.vec3]
    upper: wp.array[wp.vec3]
    left: wp.array[int]  # a leaf: its first place in `order`
    right: wp.array[int]  # a leaf: one past its last
    leaf: wp.array[int]
    order: wp.array[int]  # triangles in the order of the leaves
    count: wp.array[int]  # triangles below a node


@wp.func_native("return wp::mesh_get(id).bvh.num_nodes;")
def node_count(id: wp.uint64) -> int: ...


@wp.func_native("return *wp::mesh_get(id).bvh.root;")
def root_node(id: wp.uint64) -> int: ...


@wp.func_native("return wp::mesh_get(id).bvh.primitive_indices[i];")
def ordered_triangle(id: wp.uint64, i: int) -> int: ...


@wp.func_native("""
    const auto& n = wp::mesh_get(id).bvh.node_lowers[i];
    return wp::vec3(n.x, n.y, n.z);
""")
def node_lower(id: wp.uint64, i: int) -> wp.vec3: ...


@wp.func_native("""
    const auto& n = wp::mesh_get(id).bvh.node_uppers[i];
    return wp::vec3(n.x, n.y, n.z);
""")
def node_upper(id: wp.uint64, i: int) -> wp.vec3: ...


@wp.func_native("return (int)wp::mesh_get(id).bvh.node_lowers[i].i;")
def node_left(id: wp.uint64, i: int) -> int: ...


@wp.func_native("return (int)wp::mesh_get(id).bvh.node_uppers[i].i;")
def node_right(id: wp.uint64, i: int) -> int: ...


@wp.func_native("return (int)wp::mesh_get(id).bvh.node_lowers[i].b;")
def node_is_leaf(id: wp.uint64, i: int) -> int: ...


@wp.kernel
def measure_tree(mesh: wp.uint64, result: wp.array[int]):
    """One thread writes the number of nodes and the root."""
    result[0] = node_count(mesh)
    result[1] = root_node(mesh)


@wp.kernel
def read_tree(offset: int, mesh: wp.uint64, tree: BinaryTree):
    """One thread copies one node; those past the triangles' number skip the order."""
    i = offset + wp.tid()
    tree.lower[i] = node_lower(mesh, i)
    tree.upper[i] = node_upper(mesh, i)
    tree.left[i] = node_left(mesh, i)
    tree.right[i] = node_right(mesh, i)
    tree.leaf[i] = node_is_leaf(mesh, i)
    if i < tree.order.shape[0]:
        tree.order[i] = ordered_triangle(mesh, i)


@wp.func
def half_area(tree: BinaryTree, i: int):
    e = tree.upper[i] - tree.lower[i]
    return e[0] * e[1] + e[1] * e[2] + e[2] * e[0]


@wp.func
def is_block(tree: BinaryTree, i: int):
    return tree.leaf[i] != 0 or tree.count[i] <= LANES


@wp.kernel
def count_triangles(tree: BinaryTree, root: int, stack: wp.array[int]):
    """One thread counts the triangles below every node, children before parents."""
    top = int(1)
    stack[0] = root
    while top > 0:
        node = stack[top - 1]
        if tree.leaf[node] != 0:
            tree.count[node] = tree.right[node] - tree.left[node]
            top -= 1
        elif tree.count[node] == 0:
            tree.count[node] = -1  # seen; its children come first
            stack[top] = tree.left[node]
            stack[top + 1] = tree.right[node]
            top += 2
        else:
            tree.count[node] = tree.count[tree.left[node]] + tree.count[tree.right[node]]
            top -= 1


@wp.func
def write_block(
    tree: BinaryTree,
    node: int,
    block: int,
    corners: wp.array2d[wp.vec3],
    blocks: wp.array[float],
    faces: wp.array[int],
    stack: wp.array[int],
    base: int,
):
    """Packs the triangles below a node, at most eight, into one leaf."""
    lane = int(0)
    top = base + 1
    stack[base] = node
    while top > base:
        top -= 1
        n = stack[top]
        if tree.leaf[n] == 0:
            stack[top] = tree.left[n]
            stack[top + 1] = tree.right[n]
            top += 2
        else:
            for place in range(tree.left[n], tree.right[n]):
                face = tree.order[place]
                for corner in range(3):
                    for axis in range(3):
                        blocks[block * BLOCK_STRIDE + (3 * corner + axis) * LANES + lane] = corners[face, corner][axis]
                faces[block * LANES + lane] = face
                lane += 1


@wp.kernel
def widen_tree(
    tree: BinaryTree,
    root: int,
    corners: wp.array2d[wp.vec3],
    nodes: wp.array[float],
    children: wp.array[int],
    blocks: wp.array[float],
    faces: wp.array[int],
    source: wp.array[int],
    level: wp.array[int],
    stack: wp.array[int],
    totals: wp.array[int],
):
    """One thread, breadth first: a node takes its binary descendants, the largest opened first, until it has eight."""
    node_total = int(1)
    block_total = int(0)
    source[0] = root
    done = int(0)
    kids = wp.zeros(shape=(8,), dtype=int)
    while done < node_total:
        # gather up to eight children
        n = int(1)
        kids[0] = source[done]
        opening = int(1)
        while opening == 1 and n < LANES:
            widest = int(-1)
            area = float(-1.0)
            for k in range(n):
                if not is_block(tree, kids[k]) and half_area(tree, kids[k]) > area:
                    widest = k
                    area = half_area(tree, kids[k])
            if widest < 0:
                opening = 0
            else:
                opened = kids[widest]
                kids[widest] = tree.left[opened]
                kids[n] = tree.right[opened]
                n += 1
        # write them
        for k in range(n):
            kid = kids[k]
            low = tree.lower[kid]
            high = tree.upper[kid]
            for axis in range(3):
                margin = BOX_MARGIN * wp.max(wp.abs(low[axis]), wp.abs(high[axis]))
                nodes[done * NODE_STRIDE + axis * LANES + k] = low[axis] - margin
                nodes[done * NODE_STRIDE + (3 + axis) * LANES + k] = high[axis] + margin
            if is_block(tree, kid):
                children[done * LANES + k] = -1 - block_total
                write_block(tree, kid, block_total, corners, blocks, faces, stack, 0)
                block_total += 1
            else:
                children[done * LANES + k] = node_total
                source[node_total] = kid
                level[node_total] = level[done] + 1
                node_total += 1
        done += 1
    totals[0] = node_total
    totals[1] = block_total
    totals[2] = level[node_total - 1] + 1
