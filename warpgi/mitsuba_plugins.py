"""What Mitsuba 3 (Jakob et al. 2022) has no plugin for: our surfaces and spot lights, in its own terms.

Written in Python against Mitsuba's base classes. In a vectorised variant they compile into its kernels and cost nothing
there; in a scalar variant every call runs in Python, about ten times slower than its own plugins.
"""

from __future__ import annotations

import math
from typing import Any

SURFACE, SPOT = "warpgi_surface", "warpgi_spot"

_registered: set[str] = set()


def register(mi: Any) -> None:
    """Makes the plugins known to the variant of the module `mitsuba` that is set."""
    if mi.variant() not in _registered:
        mi.register_bsdf(SURFACE, _surface_class(mi))
        mi.register_emitter(SPOT, _spot_class(mi))
        _registered.add(mi.variant())


def _surface_class(mi: Any) -> type:
    import drjit as dr

    flags = mi.BSDFFlags

    class Surface(mi.BSDF):
        """Diffuse, conductor or mirror, alike on both sides, with our rules for shading normals.

        Mitsuba's own plugins look at the shading normal alone: light may then come through the surface, and a normal
        turned away from the viewer counts as the back. Here both sides are those of the triangle.

        Properties: `kind` "diffuse", "conductor" or "mirror"; `reflectance`, a texture; of a conductor the `exponent`
        of the Blinn distribution and, for the exact Fresnel term in place of Schlick's, `eta` and `k`.
        """

        def __init__(self, props: Any) -> None:
            mi.BSDF.__init__(self, props)
            self.kind = props["kind"]
            self.reflectance = props.get_texture("reflectance")
            self.exponent = props.get("exponent", 1.0)
            self.index = None  # complex index of refraction of each channel
            if "eta" in props:
                eta, k = props["eta"], props["k"]
                self.index = [mi.Complex2f(eta[c], k[c]) for c in range(3)]
            lobes = {
                "diffuse": flags.DiffuseReflection,
                "conductor": flags.GlossyReflection,
                "mirror": flags.DeltaReflection,
            }
            self.lobe = lobes[self.kind]
            sides = flags.FrontSide | flags.BackSide
            self.m_components = [self.lobe | sides]
            self.m_flags = self.lobe | sides

        def traverse(self, callback: Any) -> None:
            callback.put("reflectance", self.reflectance, mi.ParamFlags.Differentiable)

        def to_string(self) -> str:
            return f"Surface[{self.kind}, reflectance = {self.reflectance}]"

        def sample(self, ctx: Any, si: Any, sample1: Any, sample2: Any, active: Any = True) -> Any:
            """Direction, and value times cosine over density; 0 where it would go through the surface."""
            frame, side, viewer = _facing(si)
            if self.kind == "diffuse":
                towards = mi.warp.square_to_cosine_hemisphere(sample2)
            elif self.kind == "mirror":
                towards = mi.Vector3f(-viewer.x, -viewer.y, viewer.z)
            else:
                # half vector with density (e + 1) / (2 pi) cos^e (Pharr, Humphreys 2010, sec. 14.5)
                log_cos = dr.log(1.0 - sample2.x) / (self.exponent + 1.0)
                cos_h = dr.exp(log_cos)
                sin_h = dr.sqrt(dr.maximum(0.0, -2.0 * cos_h * dr.sinh(log_cos)))
                sin_phi, cos_phi = dr.sincos(2.0 * dr.pi * sample2.y)
                half = mi.Vector3f(sin_h * cos_phi, sin_h * sin_phi, cos_h)
                towards = 2.0 * dr.dot(viewer, half) * half - viewer
            world = frame.to_world(towards)
            bs = mi.BSDFSample3f()
            bs.wo = si.to_local(world)
            bs.eta = 1.0
            bs.sampled_type = +self.lobe
            bs.sampled_component = 0
            through = dr.dot(side, world) <= 0.0
            if self.kind == "mirror":
                bs.pdf = 1.0
                return bs, dr.select(active & ~mi.Mask(through), self.reflectance.eval(si, active), 0.0)
            bs.pdf = self._density(viewer, towards)
            value = self._value(si, viewer, towards, active)
            # a density of 0 has a value of 0
            weight = value / dr.maximum(bs.pdf, 1e-30)
            return bs, dr.select(active & ~mi.Mask(through), weight, 0.0)

        def eval(self, ctx: Any, si: Any, wo: Any, active: Any = True) -> Any:
            return self.eval_pdf(ctx, si, wo, active)[0]

        def pdf(self, ctx: Any, si: Any, wo: Any, active: Any = True) -> Any:
            return self.eval_pdf(ctx, si, wo, active)[1]

        def eval_pdf(self, ctx: Any, si: Any, wo: Any, active: Any = True) -> Any:
            if self.kind == "mirror":
                return mi.Color3f(0.0), mi.Float(0.0)
            frame, side, viewer = _facing(si)
            world = si.to_world(wo)
            towards = frame.to_local(world)
            value = self._value(si, viewer, towards, active)
            above = active & mi.Mask(dr.dot(side, world) > 0.0)
            return dr.select(above, value, 0.0), dr.select(active, self._density(viewer, towards), 0.0)

        def eval_diffuse_reflectance(self, si: Any, active: Any = True) -> Any:
            if self.kind == "diffuse":
                return self.reflectance.eval(si, active)
            return mi.Color3f(0.0)

        def _value(self, si: Any, viewer: Any, towards: Any, active: Any) -> Any:
            """f cos in the facing frame; Torrance-Sparrow is F D G / (4 cos_o), the other cosine cancelled."""
            reflectance = self.reflectance.eval(si, active)
            if self.kind == "diffuse":
                value = reflectance * (towards.z * dr.inv_pi)
            else:
                half = dr.normalize(viewer + towards)
                oh = dr.maximum(dr.dot(viewer, half), 1e-12)
                d = (self.exponent + 2.0) * 0.5 * dr.inv_pi * dr.power(dr.maximum(half.z, 0.0), self.exponent)
                g = dr.minimum(1.0, dr.minimum(2.0 * half.z * viewer.z / oh, 2.0 * half.z * towards.z / oh))
                value = self._fresnel(oh, reflectance) * (d * g / (4.0 * dr.maximum(viewer.z, 1e-12)))
            return dr.select(mi.Mask(towards.z > 0.0) & mi.Mask(viewer.z > 0.0), value, 0.0)

        def _density(self, viewer: Any, towards: Any) -> Any:
            if self.kind == "diffuse":
                density = towards.z * dr.inv_pi
            else:
                half = dr.normalize(viewer + towards)
                oh = dr.maximum(dr.dot(viewer, half), 1e-12)
                lobe = dr.power(dr.maximum(half.z, 0.0), self.exponent)
                density = (self.exponent + 1.0) * lobe / (8.0 * dr.pi * oh)
            return dr.select(mi.Mask(towards.z > 0.0) & mi.Mask(viewer.z > 0.0), density, 0.0)

        def _fresnel(self, cosine: Any, reflectance: Any) -> Any:
            if self.index is not None:
                return mi.Color3f(*(mi.fresnel_conductor(cosine, index) for index in self.index))
            m = 1.0 - cosine
            m2 = m * m
            return reflectance + (1.0 - reflectance) * (m2 * m2 * m)

    def _facing(si: Any) -> tuple[Any, Any, Any]:
        """Frame of the shading normal on the viewer's side, triangle's normal there, and the viewer in that frame."""
        world = si.to_world(si.wi)
        side = dr.select(dr.dot(si.n, world) >= 0.0, si.n, -si.n)
        n = si.sh_frame.n
        n = dr.select(dr.dot(n, side) >= 0.0, n, -n)
        n = dr.select(dr.dot(n, world) > 0.0, n, side)
        frame = mi.Frame3f(n)
        return frame, side, frame.to_local(world)

    return Surface


def _spot_class(mi: Any) -> type:
    import drjit as dr

    class Spot(mi.Emitter):
        """A point light in a cone with the smooth edge of glTF's KHR_lights_punctual; Mitsuba's own edge is another.

        Properties: `position` and `direction`, the `intensity` on the axis, a texture, and the angles `inner` and
        `outer` from the axis [radians] between which it falls to 0.
        """

        def __init__(self, props: Any) -> None:
            mi.Emitter.__init__(self, props)
            self.position = mi.ScalarPoint3f(props["position"])
            self.direction = mi.ScalarVector3f(props["direction"])
            self.intensity = props.get_unbounded_texture("intensity")
            inner, outer = math.cos(props["inner"]), math.cos(props["outer"])
            self.scale = 1.0 / max(inner - outer, 1e-6)
            self.offset = -outer * self.scale
            self.m_flags = +mi.EmitterFlags.DeltaPosition

        def traverse(self, callback: Any) -> None:
            callback.put("intensity", self.intensity, mi.ParamFlags.Differentiable)

        def to_string(self) -> str:
            return f"Spot[{self.position}]"

        def sample_direction(self, it: Any, sample: Any, active: Any = True) -> Any:
            """The direction to it, and the irradiance across that direction."""
            ds = mi.DirectionSample3f()
            ds.uv = mi.Point2f(0.0)
            ds.p = mi.Point3f(self.position)
            ds.n = mi.Normal3f(self.direction)
            ds.time = it.time
            ds.pdf = 1.0
            ds.delta = True
            ds.emitter = mi.EmitterPtr(self) if dr.is_jit_v(mi.Float) else self
            to_light = ds.p - it.p
            ds.dist = dr.norm(to_light)
            ds.d = to_light / ds.dist
            cosine = -dr.dot(ds.d, mi.Vector3f(self.direction))
            edge = dr.clip(cosine * self.scale + self.offset, 0.0, 1.0)
            value = self.intensity.eval(mi.SurfaceInteraction3f(), active) * (edge * edge / dr.square(ds.dist))
            return ds, dr.select(active, value, 0.0)

        def pdf_direction(self, it: Any, ds: Any, active: Any = True) -> Any:
            return mi.Float(0.0)

        def eval_direction(self, it: Any, ds: Any, active: Any = True) -> Any:
            return mi.Color3f(0.0)

        def eval(self, si: Any, active: Any = True) -> Any:
            return mi.Color3f(0.0)

        def bbox(self) -> Any:
            return mi.ScalarBoundingBox3f(self.position, self.position)

    return Spot
