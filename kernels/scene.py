"""The scene on the device: rays against its triangles, what lies at a hit, and where the next ray starts."""

import warp as wp

from warpgi.kernels.triangles import TriangleTree, walk, walk_moving

wp.set_module_options({"enable_backward": False})

DIFFUSE = wp.constant(0)
CONDUCTOR = wp.constant(1)
MIRROR = wp.constant(2)
DIELECTRIC = wp.constant(3)
COATED = wp.constant(4)

FAR = wp.constant(1.0e38)

# A hit position interpolated in float32 is off its plane by a few units in the last place of the triangle's largest
# coordinate; 32 of them are a safe distance for the next ray (in the spirit of Wächter, Binder 2019).
OFFSET_ULPS = wp.constant(32.0 * 5.9604645e-8)


@wp.struct
class ShapeRecord:
    kind: int  # DIFFUSE, CONDUCTOR, MIRROR, DIELECTRIC or COATED
    albedo: wp.vec3  # of Diffuse and the base of Coated; the reflectance of Conductor and Mirror
    texture: int  # of the albedo, -1: none
    eta: wp.vec3  # of a Conductor, 0: take Schlick's approximation; of Coated the fit of its coat's albedo, with k
    k: wp.vec3
    coat: wp.vec3  # of Coated: its excess over a smooth one, 1 / what it lets through, what it throws back inside
    exponent: float  # of the Blinn distribution
    ior: float
    emission: wp.vec3  # emitted radiance
    two_sided: int  # 1: emits on both sides
    light_pdf: float  # density per area with which light sampling picks a point here
    has_normals: int


@wp.struct
class TextureRecord:
    start: int  # of its texels
    width: int
    height: int


@wp.struct
class LightRecord:
    face: int  # of an emissive triangle, else -1
    distant: int  # 1: parallel light
    position: wp.vec3
    direction: wp.vec3  # axis of a spot; where parallel light travels
    radiance: wp.vec3  # emitted radiance, intensity or irradiance
    cone_scale: float  # KHR_lights_punctual: clamp(cos * scale + offset, 0, 1)^2; (0, 1) is a point light
    cone_offset: float


@wp.struct
class Scene:
    tree: TriangleTree
    points: wp.array[wp.vec3]  # relative to the scene's centre
    indices: wp.array[int]
    face_normals: wp.array[wp.vec3]
    face_shapes: wp.array[int]
    shapes: wp.array[ShapeRecord]
    normals: wp.array[wp.vec3]  # empty where no shape has them
    uvs: wp.array[wp.vec2]  # empty where no shape has them
    textures: wp.array[TextureRecord]
    texels: wp.array[wp.vec3h]
    lights: wp.array[LightRecord]
    light_cdf: wp.array[float]  # running sum of the lights' shares of the power
    light_count: int
    environment: wp.vec3
    moving: int  # 1: `motion` holds how far each point goes from time 0 to 1
    motion: wp.array[wp.vec3]
    time: float  # at which rays see the scene, in [0, 1]: a path sets it, on its own copy
    visible_light: int  # 1: a ray that is not aimed at a light can find one


@wp.struct
class Hit:
    face: int  # -1: none
    t: float
    u: float  # barycentric, of the triangle's first and second corner
    v: float


@wp.struct
class Surface:
    p: wp.vec3
    ng: wp.vec3  # geometric normal, counter-clockwise side
    n: wp.vec3  # shading normal on the same side as ng
    albedo: wp.vec3
    offset: float  # distance from the plane at which a new ray starts
    stretch: float  # area of the triangle in the scene's description over its area now, 1 where nothing moves


@wp.struct
class Triangle:
    a: wp.vec3
    b: wp.vec3
    c: wp.vec3
    ng: wp.vec3
    stretch: float
    moves: int


@wp.func
def closest_hit(scene: Scene, o: wp.vec3, d: wp.vec3):
    found = wp.vec4()
    if scene.moving != 0:
        found = walk_moving(scene.tree, o, d, FAR, 0, scene.time)
    else:
        found = walk(scene.tree, o, d, FAR, 0)
    h = Hit()
    h.t = found[0]
    h.u = found[1]
    h.v = found[2]
    h.face = wp.cast(found[3], wp.int32)
    return h


@wp.func
def occluded(scene: Scene, o: wp.vec3, d: wp.vec3, distance: float):
    found = wp.vec4()
    if scene.moving != 0:
        found = walk_moving(scene.tree, o, d, distance, 1, scene.time)
    else:
        found = walk(scene.tree, o, d, distance, 1)
    return wp.cast(found[3], wp.int32) >= 0


@wp.func
def triangle_at(scene: Scene, face: int):
    """Corners and normal of a triangle at the scene's time."""
    i = scene.indices[3 * face]
    j = scene.indices[3 * face + 1]
    k = scene.indices[3 * face + 2]
    t = Triangle()
    t.a = scene.points[i]
    t.b = scene.points[j]
    t.c = scene.points[k]
    t.ng = scene.face_normals[face]
    t.stretch = 1.0
    if scene.moving != 0:
        u = scene.motion[i]
        v = scene.motion[j]
        w = scene.motion[k]
        if wp.length_sq(u) + wp.length_sq(v) + wp.length_sq(w) > 0.0:
            area = wp.length(wp.cross(t.b - t.a, t.c - t.a))
            t.a = t.a + u * scene.time
            t.b = t.b + v * scene.time
            t.c = t.c + w * scene.time
            n = wp.cross(t.b - t.a, t.c - t.a)
            t.ng = wp.normalize(n)
            t.stretch = area / wp.max(wp.length(n), 1.0e-30)
            t.moves = 1
    return t


@wp.func
def turned(n: wp.vec3, before: wp.vec3, after: wp.vec3):
    """n after the least rotation that takes the unit vector `before` to `after` (Moeller, Hughes 1999)."""
    axis = wp.cross(before, after)
    c = wp.dot(before, after)
    if c <= -0.999:
        return -n
    return n * c + wp.cross(axis, n) + axis * (wp.dot(axis, n) / (1.0 + c))


@wp.func
def motion_at(scene: Scene, h: Hit):
    """How far the point of a hit goes from time 0 to 1."""
    i = scene.indices[3 * h.face]
    j = scene.indices[3 * h.face + 1]
    k = scene.indices[3 * h.face + 2]
    return scene.motion[i] * h.u + scene.motion[j] * h.v + scene.motion[k] * (1.0 - h.u - h.v)


@wp.func
def max_abs(v: wp.vec3):
    return wp.max(wp.max(wp.abs(v[0]), wp.abs(v[1])), wp.abs(v[2]))


@wp.func
def ray_offset(a: wp.vec3, b: wp.vec3, c: wp.vec3):
    """Distance from the plane of triangle abc at which a ray can start without meeting it again."""
    return OFFSET_ULPS * wp.max(wp.max(max_abs(a), max_abs(b)), max_abs(c))


@wp.func
def offset_origin(p: wp.vec3, ng: wp.vec3, offset: float, d: wp.vec3):
    """Start of a ray from p along d, on the side of the surface to which d points."""
    return p + ng * wp.where(wp.dot(ng, d) >= 0.0, offset, -offset)


@wp.func
def texel(scene: Scene, texture: TextureRecord, x: int, y: int):
    value = scene.texels[texture.start + y * texture.width + x]
    return wp.vec3(float(value[0]), float(value[1]), float(value[2]))


@wp.func
def wrap(i: int, n: int):
    m = i % n
    return wp.where(m < 0, m + n, m)


@wp.func
def lookup(scene: Scene, index: int, uv: wp.vec2):
    """Bilinear interpolation of a repeated image; v = 1 is its first row."""
    texture = scene.textures[index]
    x = (uv[0] - wp.floor(uv[0])) * float(texture.width) - 0.5
    y = (1.0 - (uv[1] - wp.floor(uv[1]))) * float(texture.height) - 0.5
    x0 = int(wp.floor(x))
    y0 = int(wp.floor(y))
    fx = x - float(x0)
    fy = y - float(y0)
    left = wrap(x0, texture.width)
    right = wrap(x0 + 1, texture.width)
    top = wrap(y0, texture.height)
    bottom = wrap(y0 + 1, texture.height)
    upper = texel(scene, texture, left, top) * (1.0 - fx) + texel(scene, texture, right, top) * fx
    lower = texel(scene, texture, left, bottom) * (1.0 - fx) + texel(scene, texture, right, bottom) * fx
    return upper * (1.0 - fy) + lower * fy


@wp.func
def surface_at(scene: Scene, h: Hit, shape: ShapeRecord):
    """Position, normals and albedo at a hit; the position from the corners, as t carries the ray's rounding."""
    i = scene.indices[3 * h.face]
    j = scene.indices[3 * h.face + 1]
    k = scene.indices[3 * h.face + 2]
    t = triangle_at(scene, h.face)
    w = 1.0 - h.u - h.v
    s = Surface()
    s.p = t.a * h.u + t.b * h.v + t.c * w
    s.ng = t.ng
    s.stretch = t.stretch
    s.offset = ray_offset(t.a, t.b, t.c)
    s.n = s.ng
    if shape.has_normals != 0:
        n = wp.normalize(scene.normals[i] * h.u + scene.normals[j] * h.v + scene.normals[k] * w)
        if t.moves != 0:
            n = turned(n, scene.face_normals[h.face], s.ng)
        side = wp.dot(n, s.ng)
        if side != 0.0:
            s.n = n * wp.sign(side)
    s.albedo = shape.albedo
    if shape.texture >= 0:
        uv = scene.uvs[i] * h.u + scene.uvs[j] * h.v + scene.uvs[k] * w
        s.albedo = wp.cw_mul(s.albedo, lookup(scene, shape.texture, uv))
    return s
