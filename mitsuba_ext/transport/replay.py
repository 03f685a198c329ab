"""Derivatives of a random walk, by tracing it a second time."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi

from .bsdfs import eval_bsdf
from .vertex import PathState, Vertex


# Not a dataclass: Dr.Jit would treat a dataclass used in a loop as part of the loop's state
class Replay:
    """Propagates derivatives at each vertex of paths that are traced a second time, with the same
    random numbers. The walk reports what the path gains at a vertex; what it gains later is the
    known radiance of the path minus what it has gathered so far. Densities, MIS weights and learned
    decisions are constants: the estimators are detached.

    Source: D. Vicini, S. Speierer, W. Jakob, *Path Replay Backpropagation*, ACM Transactions on
    Graphics 40(4), 2021, section 4.

    Parameters:
        scene: The scene.
        L: The radiance that each path gathers.
        δL: Backward: the derivative of the loss with respect to this radiance. ``None`` for forward
            mode.

    Attributes:
        derivative: Forward: the derivative of the radiance of each path, once they have ended.
    """

    def __init__(self, scene: mi.Scene, L: mi.Spectrum, δL: mi.Spectrum | None) -> None:
        self._scene, self._L, self._δL = scene, L, δL
        if δL is None:
            self._lane = dr.arange(mi.UInt32, dr.width(L))
            self._sums = dr.zeros(mi.Float, len(mi.Spectrum()) * dr.width(L))
            dr.eval(self._sums, self._lane)

    @property
    def derivative(self) -> mi.Spectrum:
        return dr.unravel(mi.Spectrum, self._sums)

    def emitted(
        self, si: mi.SurfaceInteraction3f, path: PathState, mis: mi.Float,
        emitter: mi.EmitterPtr, active: mi.Bool,
    ) -> None:  # fmt: skip
        """The path meets the light ``emitter`` at ``si``, with the MIS weight ``mis``."""
        with dr.resume_grad():
            self._propagate(path.β * mis * emitter.eval(si, active))

    def connected(
        self, vertex: Vertex, ds: mi.DirectionSample3f, share: mi.Spectrum, visible: mi.Bool
    ) -> None:
        """``vertex`` is connected to a light. The path gains ``share`` · BSDF · radiance /
        density."""
        si = vertex.si
        with dr.resume_grad():
            radiance = self._scene.eval_emitter_direction(si, ds, visible)
            bsdf = self._bsdf(vertex, si.to_local(ds.d), visible)
            gained = share * bsdf * radiance * dr.select(ds.pdf != 0, dr.rcp(ds.pdf), 0)
            self._propagate(dr.select(visible, gained, 0))

    def scattered(
        self, vertex: Vertex, wo: mi.Vector3f, L: mi.Spectrum, active: mi.Bool
    ) -> None:
        """The path continues from ``vertex`` in the direction ``wo``. It has gathered ``L`` so
        far."""
        later = self._L - L
        with dr.resume_grad():
            bsdf = self._bsdf(vertex, wo, active)
            self._propagate(dr.select(active, later * dr.relative_grad(bsdf), 0))

    def _bsdf(self, vertex: Vertex, wo: mi.Vector3f, active: mi.Bool) -> mi.Spectrum:
        return eval_bsdf(vertex.bsdf, mi.BSDFContext(), vertex.si, wo, active)[0]

    def _propagate(self, gained: mi.Spectrum) -> None:
        if not dr.grad_enabled(gained):
            return
        if self._δL is not None:
            dr.backward_from(self._δL * gained)
            return
        derivative = dr.forward_to(gained)
        count = len(derivative)
        for channel in range(count):
            dr.scatter_add(self._sums, derivative[channel], self._lane * count + channel)
