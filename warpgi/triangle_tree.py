"""Builds the tree that rays walk: `wp.Mesh` finds it, `kernels.tree_build` packs it eight wide."""

from __future__ import annotations

import numpy as np
import warp as wp

from warpgi.kernels import tree_build
from warpgi.kernels.triangles import BLOCK_FLOATS, MAX_TREE_DEPTH, NODE_FLOATS, WIDTH


def build_triangle_tree(
    points: np.ndarray, faces: np.ndarray, motion: np.ndarray | None = None
) -> dict[str, np.ndarray]:
    """The arrays of `kernels.triangles.TriangleTree`, on the host.

    Args:
        points: at time 0, shape (V, 3), float32.
        faces: shape (F, 3), int32.
        motion: of the points from time 0 to 1, shape (V, 3), float32; the tree is then that of time 1/2, whose boxes
            go from their triangles' places at time 0 to those at 1.

    Raises:
        RuntimeError: the tree is deeper than the stack of a ray allows; no scene was seen that does it.
    """
    cpu = wp.get_device("cpu")
    start = points
    if motion is not None:
        points = points + np.float32(0.5) * motion
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
    children = ints(node_bound * WIDTH)
    block_faces = wp.full(block_bound * WIDTH, -1, dtype=int, device=cpu)
    corners = wp.array(points[faces], dtype=wp.vec3, device=cpu)
    outputs = [nodes, children, blocks, block_faces, ints(node_bound), ints(node_bound), stack, totals]
    wp.launch(tree_build.widen_tree, 1, inputs=[tree, root, corners], outputs=outputs, device=cpu)
    node_count, block_count, depth = (int(i) for i in totals.numpy())
    if depth > MAX_TREE_DEPTH:
        raise RuntimeError(f"the triangle tree is {depth} levels deep, expected at most {MAX_TREE_DEPTH}")
    tree_arrays = {
        "nodes": nodes.numpy()[: node_count * NODE_FLOATS].copy(),
        "children": children.numpy()[: node_count * WIDTH].copy(),
        "blocks": blocks.numpy()[: block_count * BLOCK_FLOATS].copy(),
        "faces": block_faces.numpy()[: block_count * WIDTH].copy(),
    }
    return tree_arrays if motion is None else tree_arrays | _in_motion(tree_arrays, start[faces], motion[faces])


def _in_motion(tree: dict[str, np.ndarray], corners: np.ndarray, shifts: np.ndarray) -> dict[str, np.ndarray]:
    """Boxes and corners of a tree at time 0, and what they gain until time 1.

    A linear mean of the boxes at both ends bounds the triangles in between, as their corners move in straight lines.
    """
    faces = tree["faces"].reshape(-1, WIDTH)
    used = (faces >= 0)[:, None, None]
    # corner, axis, lane of each leaf
    first, way = (np.where(used, part[faces].transpose(0, 2, 3, 1), np.float32(0.0)) for part in (corners, shifts))
    children = tree["children"].reshape(-1, WIDTH)
    empty = tree["nodes"].reshape(-1, 6, WIDTH)[:, 0] == np.inf
    ends = [_node_boxes(children, empty, np.where(used, place, np.nan)) for place in (first, first + way)]
    # as a still tree's boxes, and as much as places in between may be rounded
    largest = np.abs(np.where(empty[:, None], 0.0, ends)).reshape(2, -1, 2, 3, WIDTH).max(axis=(0, 2))
    margin = np.float32(tree_build.BOX_MARGIN) * largest.astype(np.float32)
    grow = np.concatenate([-margin, margin], axis=1)
    begin, end = ends[0] + grow, ends[1] + grow
    with np.errstate(invalid="ignore"):
        node_motion = np.where(empty[:, None], np.float32(0.0), end - begin)
    arrays = {"nodes": begin, "node_motion": node_motion, "blocks": first, "block_motion": way}
    return {name: np.ascontiguousarray(array, np.float32).ravel() for name, array in arrays.items()}


def _node_boxes(children: np.ndarray, empty: np.ndarray, corners: np.ndarray) -> np.ndarray:
    """Boxes of all nodes' children without a margin, shape (N, 6, 8), from leaves of shape (B, 3, 3, 8)."""
    leaves = np.concatenate([np.nanmin(corners, axis=(1, 3)), np.nanmax(corners, axis=(1, 3))], axis=1)
    boxes = np.empty((len(children), 6, WIDTH), np.float32)
    boxes[:, :3], boxes[:, 3:] = np.inf, -np.inf
    for node in range(len(children) - 1, -1, -1):  # a node's children come after it
        for lane in np.flatnonzero(~empty[node]):
            child = children[node, lane]
            if child < 0:
                boxes[node, :, lane] = leaves[-1 - child]
            else:
                boxes[node, :3, lane] = boxes[child, :3].min(axis=1)
                boxes[node, 3:, lane] = boxes[child, 3:].max(axis=1)
    return boxes


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
