"""Derivatives of a random walk, by tracing it a second time."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi

from .bsdfs import eval_bsdf
from .free_flight import interaction_at
from .media import eval_phase
from .transmittance import Way
from .vertex import MediumVertex, PathState, Vertex


# Not dataclasses: Dr.Jit would treat a dataclass used in a loop as part of the loop's state
class FirstPass:
    """The first of two passes along the same paths, in scenes with media: the walk draws the same
    random numbers as in the second (:class:`Replay`)."""

    def flown(
        self, ray: mi.Ray3f, medium: mi.MediumPtr, u: mi.Float, si: mi.SurfaceInteraction3f,
        in_medium: MediumVertex, L: mi.Spectrum, active: mi.Bool,
    ) -> None:  # fmt: skip
        """The path has flown along ``ray`` through ``medium`` (or a vacuum) to the vertex ``si``.
        It has gathered ``L`` so far. ``u`` is a random number."""

    def emitted(
        self, si: mi.SurfaceInteraction3f, path: PathState, mis: mi.Float,
        emitter: mi.EmitterPtr, active: mi.Bool,
    ) -> None:  # fmt: skip
        """The path meets the light ``emitter`` at ``si``, with the MIS weight ``mis``."""

    def connected(
        self, vertex: Vertex, ds: mi.DirectionSample3f, share: mi.Spectrum, visible: mi.Bool,
        way: Way | None = None,
    ) -> None:  # fmt: skip
        """``vertex`` is connected to a light. The path gains ``share`` · BSDF · radiance / density.
        ``way`` is the way of the light through media; ``None`` if the scene has none."""

    def scattered(
        self, vertex: Vertex, wo: mi.Vector3f, L: mi.Spectrum, active: mi.Bool
    ) -> None:
        """The path continues from ``vertex`` in the direction ``wo``. It has gathered ``L`` so
        far."""


class Replay(FirstPass):
    """Propagates derivatives at each vertex of paths that are traced a second time, with the same
    random numbers. The walk reports what the path gains at a vertex; what it gains later is the
    known radiance of the path minus what it has gathered so far. Densities, MIS weights and learned
    decisions are constants: the estimators are detached.

    Media attenuate light by exp(−∫ σ_t) on its way. The derivative of the exponent needs no null
    collisions: it is the length of the way times the derivative of σ_t at one uniform point of it
    (everywhere the same in homogeneous media).

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

    def flown(self, ray, medium, u, si, in_medium, L, active):
        later = self._L - L
        active = active & (medium != None)  # noqa: E711
        # Only where nothing attenuates the light is the distance infinite
        length = dr.select(active & dr.isfinite(si.t), si.t, 0)
        way = Way(interaction_at(ray, ray(u * length), medium), length)
        scatters, mei = active & in_medium.scatters, in_medium.mei
        with dr.resume_grad():
            σ_s, _, _ = mei.medium.get_scattering_coefficients(mei, scatters)
            weight = dr.select(scatters, dr.relative_grad(mi.Spectrum(σ_s)), 1)
            self._propagate(dr.select(active, later * _attenuation(way) * weight, 0))

    def emitted(self, si, path, mis, emitter, active):
        with dr.resume_grad():
            self._propagate(path.β * mis * emitter.eval(si, active))

    def connected(self, vertex, ds, share, visible, way=None):
        si = vertex.si
        with dr.resume_grad():
            radiance = self._scene.eval_emitter_direction(si, ds, visible)
            bsdf = self._bsdf(vertex, ds.d, si.to_local(ds.d), visible)
            gained = share * bsdf * radiance * dr.select(ds.pdf != 0, dr.rcp(ds.pdf), 0)
            if way is not None:
                gained *= _attenuation(way)
            self._propagate(dr.select(visible, gained, 0))

    def scattered(self, vertex, wo, L, active):
        later = self._L - L
        with dr.resume_grad():
            bsdf = self._bsdf(vertex, vertex.si.to_world(wo), wo, active)
            self._propagate(dr.select(active, later * dr.relative_grad(bsdf), 0))

    def _bsdf(self, vertex: Vertex, d: mi.Vector3f, wo: mi.Vector3f, active: mi.Bool):
        """The value of the BSDF, or of the phase function, for the direction ``d`` (in world space)
        or ``wo`` (local)."""
        value, _ = eval_bsdf(vertex.bsdf, mi.BSDFContext(), vertex.si, wo, active)
        if vertex.medium is None:
            return value
        scatters = vertex.medium.scatters
        return dr.select(scatters, eval_phase(vertex.medium.mei, d, active & scatters)[0], value)

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


def _attenuation(way: Way) -> mi.Spectrum:
    """1, with the derivative of the attenuation on ``way`` relative to the attenuation itself."""
    _, _, σ_t = way.mei.medium.get_scattering_coefficients(way.mei, way.length > 0)
    return dr.replace_grad(mi.Spectrum(1), -way.length * mi.Spectrum(σ_t))
