"""Derivatives of a random walk, by tracing it a second time."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi

from ..scene.bsdfs import is_in_table
from .bsdfs import eval_bsdf, sample_bsdf
from .detours import Closest, Detour, DetourPoint, detour_point
from .free_flight import interaction_at
from .media import Inside, eval_phase
from .transmittance import Way, stretch
from .vertex import FlightEnd, PathState, Vertex


# Not dataclasses: Dr.Jit would treat a dataclass used in a loop as part of the loop's state
class FirstPass:
    """The first of two passes along the same paths, in scenes with media: the walk draws the same
    random numbers as in the second (:class:`Replay`).

    Parameters:
        detours: Whether paths take detours (``detours.py``).

    Attributes:
        flights: Whether flights through media have derivatives.
        L: The radiance that each path has gathered, once they have ended.
        detour_L: What they have gathered behind their detours.
    """

    flights = True

    def __init__(self, detours: bool = False) -> None:
        self._detours = detours
        self.L, self.detour_L = mi.Spectrum(0), mi.Spectrum(0)

    def begin(self) -> Detour | None:
        """The state before the first flight."""
        if not self._detours:
            return None
        return Detour(mi.UInt32(0), mi.Bool(False), mi.Spectrum(0))

    def end(self, detour: Detour | None, L: mi.Spectrum) -> None:
        """The paths have ended, with ``L``."""
        self.L = L if detour is None else dr.select(detour.taken, detour.L, L)
        self.detour_L = L - self.L

    def flown(
        self, sampler: mi.Sampler, ray: mi.Ray3f, inside: Inside, start: FlightEnd,
        end: FlightEnd, detour: Detour | None, L: mi.Spectrum, active: mi.Bool, closest: Closest,
    ) -> tuple[FlightEnd, Detour | None, mi.Bool]:  # fmt: skip
        """A path has flown along ``ray``, and has gathered ``L`` before.

        Parameters:
            inside: The state of the path in media, during the flight.
            start: The surface in the direction of the ray, with the throughput at its origin.
            end: The vertex, with the throughput there.
            detour: The state of detours.
            closest: Finds the surface that another ray from the same vertex would meet.

        Returns:
            What a detour changes: the end, the state of detours, and which paths are active.
        """
        point, u = None, sampler.next_1d(active)
        if detour is not None:
            point, detour = detour_point(
                closest, sampler, ray, start.si.t, inside.medium, inside.channel, detour, active
            )
            detour.L = dr.select(point.chosen, L, detour.L)
        active = self._flown(ray, inside.medium, u, end, point, L, active)
        return end if point is None else point.end(start, end), detour, active

    def _flown(
        self, ray: mi.Ray3f, medium: mi.MediumPtr, u: mi.Float, end: FlightEnd,
        point: DetourPoint | None, L: mi.Spectrum, active: mi.Bool,
    ) -> mi.Bool:  # fmt: skip
        """Propagates the derivatives of a flight. Returns which paths go on. ``u`` is a random
        number."""
        return active

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
        self, vertex: Vertex, bs: mi.BSDFSample3f, sample_1: mi.Float, sample_2: mi.Point2f,
        L: mi.Spectrum, active: mi.Bool,
    ) -> None:  # fmt: skip
        """The path continues from ``vertex`` in the direction ``bs``, which ``sample_1`` and
        ``sample_2`` have chosen. It has gathered ``L`` so far."""


class Replay(FirstPass):
    """Propagates derivatives at each vertex of paths that are traced a second time, with the same
    random numbers. The walk reports what the path gains at a vertex; what it gains later is the
    known radiance of the path minus what it has gathered so far. Densities, MIS weights and learned
    decisions are constants: the estimators are detached.

    Media attenuate light by exp(−∫ σ_t) on its way. The derivative of the exponent needs no null
    collisions: it is the length of the way times the derivative of σ_t at one uniform point of it
    (everywhere the same in homogeneous media).

    What a mirror or smooth glass sends into a direction has no density. Its value is the weight of
    the sample times the probability of the lobe.

    Source: D. Vicini, S. Speierer, W. Jakob, *Path Replay Backpropagation*, ACM Transactions on
    Graphics 40(4), 2021, section 4.

    Parameters:
        scene: The scene.
        L: The radiance that each path gathers.
        δL: Backward: the derivative of the loss with respect to this radiance. ``None`` for forward
            mode.
        flights: Whether media have parameters with gradients.
        mirrors: Whether mirrors or smooth glass are optimized.
        masks: Which BSDFs contain a mask whose opacity is optimized (:func:`bsdf_table`).
        detours: As in the first pass.
        detour_L: What it gathers behind its detour; ``None`` if there are none.

    Attributes:
        derivative: Forward: the derivative of the radiance of each path, once they have ended.
    """

    def __init__(
        self, scene: mi.Scene, L: mi.Spectrum, δL: mi.Spectrum | None, flights: bool = True,
        mirrors: bool = False, masks: mi.Bool | None = None, detours: bool = False,
        detour_L: mi.Spectrum | None = None,
    ) -> None:  # fmt: skip
        super().__init__(detours)
        self.flights, self._mirrors, self._masks = flights, mirrors, masks
        self._scene, self._L, self._δL, self._detour_L = scene, L, δL, detour_L
        if δL is None:
            self._lane = dr.arange(mi.UInt32, dr.width(L))
            self._sums = dr.zeros(mi.Float, len(mi.Spectrum()) * dr.width(L))
            dr.eval(self._sums, self._lane)

    @property
    def derivative(self) -> mi.Spectrum:
        return dr.unravel(mi.Spectrum, self._sums)

    def _flown(self, ray, medium, u, end, point, L, active):
        in_media = active & (medium != None)  # noqa: E711
        before, length = stretch(medium, ray, end.si.t, in_media)
        way = Way(interaction_at(ray, ray(before + u * length), medium), length)
        mei, scatters = end.in_medium.mei, in_media & end.in_medium.scatters
        if point is not None:
            in_media &= ~point.chosen
            with dr.resume_grad():
                σ_s, σ_t = _coefficients(point.mei, point.chosen)
                share = point.rate / (dr.detach(σ_t) + point.rate)
                share = dr.select(dr.detach(σ_s) > 0, share, 1)
                self._propagate(dr.select(point.chosen, self._detour_L * share * σ_s, 0))
        with dr.resume_grad():
            σ_s, σ_t = _coefficients(mei, scatters)
            factor = dr.relative_grad(σ_s)
            if point is not None:
                σ_t = dr.detach(σ_t)
                share = dr.select(σ_t > 0, σ_t / (σ_t + point.rate), 0)
                factor = dr.replace_grad(mi.Spectrum(1), share * factor)
            gained = (self._L - L) * _attenuation(way) * dr.select(scatters, factor, 1)
            self._propagate(dr.select(in_media, gained, 0))
        # What follows a detour has no derivatives
        return active if point is None else active & ~point.chosen

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

    def scattered(self, vertex, bs, sample_1, sample_2, L, active):
        wo, later = bs.wo, self._L - L
        is_delta = active & mi.has_flag(bs.sampled_type, mi.BSDFFlags.Delta)
        if vertex.medium is not None:
            is_delta &= ~vertex.medium.scatters
        # What a mirror reflects is not light of another lobe of the BSDF
        active = active & ~is_delta
        with dr.resume_grad():
            bsdf = self._bsdf(vertex, vertex.si.to_world(wo), wo, active)
            self._propagate(dr.select(active, later * dr.relative_grad(bsdf), 0))
            if self._mirrors:
                again, weight = sample_bsdf(
                    vertex.bsdf, mi.BSDFContext(), vertex.si, sample_1, sample_2, is_delta
                )
                is_null = mi.has_flag(bs.sampled_type, mi.BSDFFlags.Null)
                passing = vertex.bsdf.eval_null_transmission(vertex.si, is_delta)
                value = weight * again.pdf
                if self._masks is not None:
                    # Both the weight and the density have the derivative of the opacity
                    covered = ~is_null & is_in_table(self._masks, vertex.bsdf)
                    value /= dr.select(covered, 1 - passing, 1)
                value = dr.select(is_null, passing, value)
                self._propagate(dr.select(is_delta, later * dr.relative_grad(value), 0))

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
    _, σ_t = _coefficients(way.mei, way.length > 0)
    return dr.replace_grad(mi.Spectrum(1), -way.length * σ_t)


def _coefficients(
    mei: mi.MediumInteraction3f, active: mi.Bool
) -> tuple[mi.Spectrum, mi.Spectrum]:
    """σ_s and σ_t."""
    σ_s, _, σ_t = mei.medium.get_scattering_coefficients(mei, active)
    return mi.Spectrum(σ_s), mi.Spectrum(σ_t)
