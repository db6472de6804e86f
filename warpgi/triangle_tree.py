"""Builds the tree that rays walk: `wp.Mesh` finds it, `kernels.tree_build` packs it eight wide."""

from __future__ import annotations

import numpy as np
import warp as wp

from warpgi.kernels import tree_build
from warpgi.kernels.triangles import BLOCK_FLOATS, MAX_TREE_DEPTH, NODE_FLOATS, WIDTH


def build_triangle_tree(points: np.ndarray, faces: np.ndarray) -> dict[str, np.ndarray]:
    """The arrays of `kernels.triangles.TriangleTree`, on the host.

    Args:
        points: shape (V, 3), float32.
        faces: shape (F, 3), int32.

    Raises:
        RuntimeError: the tree is deeper than the stack of a ray allows; no scene was seen that does it.
    """
    cpu = wp.get_device("cpu")
    # one triangle a leaf here: which go together is decided when leaves of eight are packed
    mesh = wp.Mesh(
        wp.array(points, dtype=wp.vec3, device=cpu),
        wp.array(faces.ravel(), dtype=int, device=cpu),
        bvh_constructor="sah",
        bvh_leaf_size=1,
    )

    def ints(count: int) -> wp.array:
        return wp.zeros(count, dtype=int, device=cpu)

    totals = ints(3)
    wp.launch(tree_build.measure_tree, 1, inputs=[mesh.id], outputs=[totals], device=cpu)
    count, root = (int(i) for i in totals.numpy()[:2])
    tree = tree_build.BinaryTree()
    for name in ("left", "right", "leaf", "count"):
        setattr(tree, name, ints(count))
    tree.lower = wp.zeros(count, dtype=wp.vec3, device=cpu)
    tree.upper = wp.zeros(count, dtype=wp.vec3, device=cpu)
    tree.order = ints(len(faces))
    wp.launch(tree_build.read_tree, count, inputs=[0, mesh.id], outputs=[tree], device=cpu)
    count = _split_large_leaves(tree, points[faces])
    tree.count = ints(count)
    stack = ints(count + 2)
    wp.launch(tree_build.count_triangles, 1, inputs=[tree, root], outputs=[stack], device=cpu)

    # nodes that hold more than a leaf's triangles stay nodes, at most; their other children become leaves
    below, leaf = tree.count.numpy(), tree.leaf.numpy() != 0
    inner = np.flatnonzero(~leaf & (below > WIDTH))
    kids = np.concatenate([tree.left.numpy()[inner], tree.right.numpy()[inner]])
    node_bound, block_bound = max(1, len(inner)), max(1, int(np.count_nonzero(leaf[kids] | (below[kids] <= WIDTH))))
    boxes = np.empty((node_bound, 6, WIDTH), np.float32)
    boxes[:, :3], boxes[:, 3:] = np.inf, -np.inf
    nodes = wp.array(boxes.ravel(), dtype=float, device=cpu)
    blocks = wp.zeros(block_bound * BLOCK_FLOATS, dtype=float, device=cpu)
    children, block_faces = ints(node_bound * WIDTH), ints(block_bound * WIDTH)
    corners = wp.array(points[faces], dtype=wp.vec3, device=cpu)
    outputs = [nodes, children, blocks, block_faces, ints(node_bound), ints(node_bound), stack, totals]
    wp.launch(tree_build.widen_tree, 1, inputs=[tree, root, corners], outputs=outputs, device=cpu)
    node_count, block_count, depth = (int(i) for i in totals.numpy())
    if depth > MAX_TREE_DEPTH:
        raise RuntimeError(f"the triangle tree is {depth} levels deep, expected at most {MAX_TREE_DEPTH}")
    return {
        "nodes": nodes.numpy()[: node_count * NODE_FLOATS].copy(),
        "children": children.numpy()[: node_count * WIDTH].copy(),
        "blocks": blocks.numpy()[: block_count * BLOCK_FLOATS].copy(),
        "faces": block_faces.numpy()[: block_count * WIDTH].copy(),
    }


def _split_large_leaves(tree: tree_build.BinaryTree, corners: np.ndarray) -> int:
    """Halves leaves of more than WIDTH triangles, which `wp.Mesh` makes 32 levels deep; returns the number of nodes."""
    sizes = (tree.right.numpy() - tree.left.numpy()) * (tree.leaf.numpy() != 0)
    todo = np.flatnonzero(sizes > WIDTH).tolist()
    if not todo:
        return len(sizes)
    names = ("left", "right", "leaf", "lower", "upper")
    columns = [list(getattr(tree, name).numpy()) for name in names]
    left, right, leaf = columns[:3]
    order, middle = tree.order.numpy(), corners.mean(axis=1)
    while todo:
        node = todo.pop()
        first, last = left[node], right[node]
        places = order[first:last]
        order[first:last] = places[np.argsort(middle[places][:, np.ptp(middle[places], axis=0).argmax()])]
        half = (first + last) // 2
        left[node], right[node], leaf[node] = len(leaf), len(leaf) + 1, 0
        for a, b in ((first, half), (half, last)):
            inside = corners[order[a:b]]
            if b - a > WIDTH:
                todo.append(len(leaf))
            row = (a, b, 1, inside.min(axis=(0, 1)), inside.max(axis=(0, 1)))
            for values, value in zip(columns, row, strict=True):
                values.append(value)
    for name, values in zip(names, columns, strict=True):
        dtype = wp.vec3 if name in ("lower", "upper") else int
        setattr(tree, name, wp.array(np.array(values), dtype=dtype, device="cpu"))
    tree.order = wp.array(order, dtype=int, device="cpu")
    return len(leaf)
