"""The first apparent surface along a ray of the camera (Lehtinen et al. 2012, sections 2.3.2 and 3.4).

Where indirect light is gathered, an error at a surface's rim is one of many directions' in a sum; here it is the rim
in the picture. So splats keep the size that their neighbours gave them, and a surface stops a ray only where the ray
goes through the hull of its samples, as in Lehtinen et al. 2011, or close by one of them: within a part of the
distance at which the nearest input ray passed it unhindered. Samples three times that distance away or more are no
part of the hull.
"""

import warp as wp

from warpgi.kernels.splats import SURFACE, SplatTree, vec10

wp.set_module_options({"enable_backward": False})

MOST_PASSED = 48  # samples of surfaces that a ray may pass by

TRUST_SIZES = (
    "        if (keep_one >= 1.0f || inside == 0 || inside > 2 || limit >= 1.0e30f || passed_count + inside > 16)\n"
    """            break;
        if (closest <= (inside == 1 ? keep_one : keep_two))
            break;
"""
)
COVERS = """        if (inside == 0 || (limit >= 1.0e30f && !open) || passed_count + inside > 48)
            break;
        {
            const wp::vec3 axis = wp::abs(d[0]) < 0.7f ? wp::vec3(1.0f, 0.0f, 0.0f) : wp::vec3(0.0f, 1.0f, 0.0f);
            const wp::vec3 s = wp::normalize(wp::cross(d, axis)), t = wp::cross(d, s);
            float ax[72], ay[72];
            int n = 0;
            bool covered = false;
            for (int j = 0; j < size; ++j) {
                if (t_of[j] < limit) {
                    const int splat = place[j] >= 0 ? place[j] : -1 - place[j];
                    const float r2 = tree.blocks.data[(size_t)(splat / 8) * 80 + splat % 8 + 48];
                    const float away2 = e_of[j] * r2;
                    covered = covered | (away2 <= part2 * free2.data[splat]);
                    // a hull of samples that input rays passed much nearer by would span gaps
                    if (away2 <= 9.0f * free2.data[splat]) {
                        const float bx = hx[j] - o[0], by = hy[j] - o[1], bz = hz[j] - o[2];
                        ax[n] = bx * s[0] + by * s[1] + bz * s[2];
                        ay[n] = bx * t[0] + by * t[1] + bz * t[2];
                        ++n;
                    }
                }
            }
            if (!covered) {
                // inside the hull unless some sample has all others on one side of its direction
                covered = n >= 3;
                for (int i = 0; i < n && covered; ++i) {
                    bool left = true;
                    for (int j = 0; j < n; ++j)
                        left = left & (ax[i] * ay[j] - ay[i] * ax[j] >= 0.0f);
                    covered = !left;
                }
            }
            if (covered)
                break;
        }
"""


# Tents of one volume: a large splat, of few samples far apart, does not outweigh small ones of a denser surface by it.
TENT = "const float w = 1.0f - wp::sqrt(e_of[j]);"
TENT_OF_ONE_VOLUME = "const float w = (1.0f - wp::sqrt(e_of[j])) / larger(q[48], 1.0e-30f);"


def _replaced(walk: str, *changes: tuple[str, str]) -> str:
    for old, new in changes:
        if walk.count(old) != 1:
            raise ImportError(f"the walk through splats does not hold what is to be replaced: {old.strip()[:60]}")
        walk = walk.replace(old, new)
    return walk


LENS_SURFACE = _replaced(
    SURFACE,
    (TRUST_SIZES, COVERS),
    (TENT, TENT_OF_ONE_VOLUME),
    ("int passed[16];", f"int passed[{MOST_PASSED}];"),
    ("1.0e-4f * (dx * dx + dy * dy + dz * dz)", "slope2 * smaller(dx * dx + dy * dy + dz * dz, 4.0f * p[48 + k])"),
)


# `free2` holds, for each splat, the squared distance at which the nearest input ray passed it; `part2` is the squared
# part of it that a sample covers by itself; `slope2` the squared sine of the angle by which samples of one surface may
# lie off each other's planes; `open` is 1 where a ray may leave the scene, 0 where the last surface stops it.
# Returns what `first_surface` does.
@wp.func_native(LENS_SURFACE)
def lens_surface(
    tree: SplatTree,
    free2: wp.array[float],
    o: wp.vec3,
    d: wp.vec3,
    noise: float,
    reach: float,
    part2: float,
    slope2: float,
    open: int,
) -> vec10: ...
