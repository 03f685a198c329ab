"""An emitter that moves with the frame in which another one rests.

This file is executed once per variant (see ``registry.py``): its base class is variant-bound.
"""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np

from ..scene.motion.rigid_motion import Motion, Pose, PoseTable
from ..startup.registry import variant_bound


@variant_bound
class MovingEmitter(mi.Emitter):
    """A moving emitter. For each call, points and directions are transformed to the frame in which
    ``nested`` rests, by the pose at the time of the call, and the results are transformed back.
    Densities per area and per solid angle are the same in both frames.

    Parameters:
        name: Name of the plugin.
        nested: The emitter at rest.
        motion: The motion of its frame.

    Attributes:
        nested (mi.Emitter): The emitter at rest.
        motion (Motion): The motion of its frame.
    """

    def __init__(self, name: str, nested: mi.Emitter, motion: Motion, id: str = "") -> None:
        own = mi.Properties(name)
        own.set_id(id or nested.id())
        own["sampling_weight"] = nested.sampling_weight()
        if (medium := nested.get_medium()) is not None:
            own["medium"] = medium
        super().__init__(own)
        self.name, self.nested, self.motion = name, nested, motion
        self._poses = PoseTable([motion])
        self.m_flags = nested.flags()

    # ---- Mitsuba's interface ----

    def sample_direction(self, it, sample, active=True):
        pose = self._pose(it.time)
        ds, weight = self.nested.sample_direction(_point_at_rest(pose, it), sample, active)
        ds.p, ds.d, ds.n = pose.point_to_world(ds.p), pose.rotation @ ds.d, pose.rotation @ ds.n
        ds.time, ds.emitter = it.time, mi.EmitterPtr(self)
        return ds, weight

    def pdf_direction(self, it, ds, active=True):
        pose = self._pose(it.time)
        return self.nested.pdf_direction(
            _point_at_rest(pose, it), _sample_at_rest(pose, ds), active
        )

    def eval_direction(self, it, ds, active=True):
        pose = self._pose(it.time)
        return self.nested.eval_direction(
            _point_at_rest(pose, it), _sample_at_rest(pose, ds), active
        )

    def eval(self, si, active=True):
        # ``si.wi`` is relative to the surface, so that the frame does not matter
        return self.nested.eval(si, active)

    def sample_ray(self, time, sample1, sample2, sample3, active=True):
        ray, weight = self.nested.sample_ray(time, sample1, sample2, sample3, active)
        return self._pose(time).ray_to_world(ray), weight

    def sample_position(self, time, sample, active=True):
        ps, weight = self.nested.sample_position(time, sample, active)
        pose = self._pose(time)
        ps.p, ps.n = pose.point_to_world(ps.p), pose.rotation @ ps.n
        return ps, weight

    def sample_wavelengths(self, si, sample, active=True):
        return self.nested.sample_wavelengths(si, sample, active)

    def bbox(self):
        box = self.nested.bbox()
        if not box.valid():  # Mitsuba's projector has none
            origin = np.array(self.nested.world_transform().matrix).reshape(4, 4)[:3, 3]
            box = mi.ScalarBoundingBox3f(mi.ScalarPoint3f(origin), mi.ScalarPoint3f(origin))
        return self.motion.box(box)

    def traverse(self, callback):
        self.nested.traverse(callback)

    def parameters_changed(self, keys):
        if "sampling_weight" in keys:
            raise NotImplementedError(
                f'"{self.name}": the sampling_weight cannot be changed after loading'
            )
        self.nested.parameters_changed(keys)

    def to_string(self):
        nested = str(self.nested).replace("\n", "\n  ")
        return f"{self.name}[\n  segments = {len(self.motion.turns)},\n  nested = {nested}\n]"

    # ---- Helpers ----

    def _pose(self, time: mi.Float) -> Pose:
        return self._poses.pose(mi.UInt32(0), time)


def _point_at_rest(pose: Pose, it: mi.Interaction3f) -> mi.Interaction3f:
    at_rest = mi.Interaction3f(it)
    at_rest.p, at_rest.n = pose.point_to_rest(it.p), pose.rotation.T @ it.n
    return at_rest


def _sample_at_rest(pose: Pose, ds: mi.DirectionSample3f) -> mi.DirectionSample3f:
    at_rest = dr.copy(ds)
    inverse = pose.rotation.T
    at_rest.p, at_rest.d, at_rest.n = pose.point_to_rest(ds.p), inverse @ ds.d, inverse @ ds.n
    return at_rest
