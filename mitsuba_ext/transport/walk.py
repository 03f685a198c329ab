"""The traced random walk that all unidirectional integrators share.

The walk is Mitsuba's ``path``: next event estimation, multiple importance sampling with the power
heuristic, Russian roulette. With the default decisions it draws the same random numbers in the
same order, so that a render of one pass returns the same image. A technique replaces one decision
(see ``decisions/``); Dr.Jit inlines Python while it traces, so a replaced decision costs what it
does and a default one nothing.

Dr.Jit's loops see local variables only. Whatever a decision changes from one bounce to the next is
therefore a *state* that its methods take and return; its attributes are read-only during the walk.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import drjit as dr
import mitsuba as mi

from ..decisions import (
    AlwaysTest,
    DirectionSamples,
    EmitterSampling,
    Roulette,
    SceneQuery,
    ShadowTest,
    ThroughputRoulette,
)
from ..garbage import garbage_left_alone
from .heroes import Heroes
from .mis import power_heuristic


@dataclass
class PathSample:
    """What one camera ray brings back.

    Attributes:
        L: Radiance estimate.
        valid: Did the path meet a surface (or the visible environment)? It becomes alpha.
        scatter_count: Rays traced in directions that a BSDF chose.
        shadow_count: Shadow rays traced.
        connection_count: Connections to a light that were considered: ``path`` traces a shadow ray
            for each of them.
        aovs: Values of arbitrary output variables, if the walk finds any.
    """

    L: mi.Spectrum
    valid: mi.Bool
    scatter_count: mi.UInt32
    shadow_count: mi.UInt32
    connection_count: mi.UInt32
    aovs: list[mi.Float] = field(default_factory=list)


@dataclass
class Walk:
    """A path tracer whose decisions can be replaced.

    Parameters:
        max_depth: Longest path in segments; 1 shows emitters only, 2**32 − 1 stands for no limit.
        rr_depth: Depth at which Russian roulette begins.
        hide_emitters: Do camera rays pass through area lights, and is the environment invisible?
        directions: Which primary samples choose the lobe and the direction of a BSDF sample.
        next_event: Which point of which light to connect to, and with what pdf.
        shadow_test: Whether the shadow ray of a connection is traced.
        roulette: With which probability a path goes on, from ``rr_depth`` on.
        query: How a ray meets the scene.
        observer: Is told what happens (``learning.learner.Observer``); ``None`` in final stages.
    """

    max_depth: int
    rr_depth: int
    hide_emitters: bool = False
    directions: DirectionSamples = field(default_factory=DirectionSamples)
    next_event: EmitterSampling = field(default_factory=EmitterSampling)
    shadow_test: ShadowTest = field(default_factory=AlwaysTest)
    roulette: Roulette = field(default_factory=ThroughputRoulette)
    query: SceneQuery = field(default_factory=SceneQuery)
    observer: Any = None

    def __call__(
        self,
        scene: mi.Scene,
        sampler: mi.Sampler,
        ray: mi.Ray3f,
        active: mi.Bool,
        pixel: mi.UInt32 | None = None,
        hero_weight: mi.Float | float = 1.0,
    ) -> PathSample:
        """Traces one path for each lane of ``ray``. ``pixel`` is where on the film it begins, row
        by row; a walk without decisions that learn can do without. ``hero_weight`` multiplies what
        reaches the camera by paths of which only one wavelength is left (see ``dispersion.py``)."""
        with garbage_left_alone():
            return self._trace(scene, sampler, ray, active, pixel, hero_weight)

    @dr.syntax
    def _trace(self, scene, sampler, ray, active, pixel, hero_weight) -> PathSample:
        # What the scene lacks is left out of the kernel: these are Python booleans
        has_emitters = len(scene.emitters()) > 0
        connects = has_emitters and self.max_depth > 1
        can_hit_emitters = has_emitters and _emitters_can_be_hit(scene)
        sees_environment = scene.environment() is not None and not self.hide_emitters

        # --------------------- Configure the loop state ----------------------
        heroes = Heroes(scene, hero_weight)
        ctx = heroes.context()
        ray = mi.Ray3f(ray)
        L = mi.Spectrum(0)                              # Radiance accumulator
        β = mi.Spectrum(1)                              # Path throughput weight
        η = mi.Float(1)                                 # Product of relative indices of refraction
        guidance = mi.Float(1)                          # Part of β that says nothing about its use
        depth = mi.UInt32(0)                            # Depth of the current vertex
        valid = mi.Bool(sees_environment and self.max_depth > 0)  # Has the path met anything?
        prev_si = dr.zeros(mi.Interaction3f)            # Previous scattering event
        prev_bsdf_pdf = mi.Float(1)
        prev_bsdf_delta = mi.Bool(True)
        scatter_count, shadow_count, connection_count = mi.UInt32(0), mi.UInt32(0), mi.UInt32(0)
        active = mi.Bool(active) & (self.max_depth > 0)
        directions_state = self.directions.begin(sampler, ray, pixel)
        next_event_state = self.next_event.begin(sampler, ray)
        shadow_state = self.shadow_test.begin(sampler, ray)
        roulette_state = self.roulette.begin(sampler, ray, pixel)
        hero_is_alone = heroes.begin()
        if dr.hint(self.observer is not None, mode="scalar"):
            self.observer.begin(dr.width(ray), pixel)

        pi = self.query.closest(scene, ray, coherent=True, active=active)
        if dr.hint(self.hide_emitters, mode="scalar"):
            ray, pi = self._skip_emitters(scene, ray, pi, active)

        while dr.hint(active, label="walk"):
            si = self.query.interaction(pi, ray)

            # ----- How much does this vertex emit towards the previous one? -----
            if dr.hint(can_hit_emitters, mode="scalar"):
                L, next_event_state = self._add_emission(
                    next_event_state, scene, L, β, si, prev_si, prev_bsdf_pdf, prev_bsdf_delta
                )

            # ----- Should we continue tracing to reach one more vertex? -----
            active_next = (depth + 1 < self.max_depth) & si.is_valid()
            bsdf = si.bsdf(ray)

            # ----- Which point of which light do we connect to? -----
            active_em = active_next & mi.has_flag(bsdf.flags(), mi.BSDFFlags.Smooth)
            if dr.hint(self.observer is not None, mode="scalar"):
                self.observer.vertex(si, depth, active_em)
            if dr.hint(connects and self.next_event.gathers, mode="scalar"):
                gathered, shadow_rays = self.next_event.gather(
                    scene, sampler, self.query, ctx, heroes, si, bsdf, active_em & (depth == 0)
                )
                L = dr.fma(β, gathered, L)
                shadow_count += shadow_rays
                connection_count += shadow_rays
            ds, em_weight, next_event_state = self._sample_emitter(
                connects, next_event_state, scene, sampler, si, active_em
            )
            wo = si.to_local(ds.d)

            # ----- Evaluate the BSDF towards the light and choose where to scatter -----
            sample_1, sample_2, directions_weight, directions_state = self.directions.draw(
                directions_state, sampler, si, depth, active_next
            )
            bsdf_value, bsdf_pdf, bs, bsdf_weight = bsdf.eval_pdf_sample(
                ctx, si, wo, sample_1, sample_2
            )
            bsdf_value = heroes.connect(hero_is_alone, bsdf_value, bsdf, si, wo)
            bsdf_weight, hero_count, hero_is_alone = heroes.scatter(
                hero_is_alone, bsdf_weight, bsdf, si, bs
            )

            # ----- Does the light reach this vertex? -----
            if dr.hint(connects, mode="scalar"):
                bsdf_value = si.to_world_mueller(bsdf_value, -wo, si.wi)
                mis = dr.select(ds.delta, 1, power_heuristic(ds.pdf, bsdf_pdf))
                contribution = bsdf_value * em_weight
                unoccluded = β * contribution * mis
                active_em &= ds.pdf != 0
                connection_count += dr.select(active_em, 1, 0)
                # A connection that cannot contribute needs no shadow ray
                active_em &= dr.max(dr.abs(unoccluded)) > 0
                unoccluded, active_em, shadow_state = self._shadow_roulette(
                    shadow_state, next_event_state, sampler, si, ds, unoccluded, active_em
                )
                visible = active_em & ~self.query.occluded(scene, si, ds, active_em)
                L[visible] += unoccluded
                shadow_count += dr.select(active_em, 1, 0)
                if dr.hint(self.observer is not None, mode="scalar"):
                    self.observer.connection(
                        next_event_state, si, ds, contribution, visible, active_em
                    )
            if dr.hint(self.observer is not None, mode="scalar"):
                self.observer.direction(
                    si, depth, sample_2, directions_weight, L, active_next
                )

            # ----- Move on to the next vertex -----
            bsdf_weight = si.to_world_mueller(bsdf_weight, -bs.wo, si.wi)
            ray = si.spawn_ray(si.to_world(bs.wo))
            β *= bsdf_weight * directions_weight
            guidance *= directions_weight * hero_count
            η *= bs.eta
            valid |= si.is_valid() & ~mi.has_flag(bs.sampled_type, mi.BSDFFlags.Null)

            prev_si = mi.Interaction3f(si)
            prev_bsdf_pdf = bs.pdf
            prev_bsdf_delta = mi.has_flag(bs.sampled_type, mi.BSDFFlags.Delta)
            depth[si.is_valid()] += 1

            # ----- Russian roulette -----
            β_max = dr.max(β)
            rr_active = depth >= self.rr_depth
            rr_probability, roulette_state = self.roulette.probability(
                roulette_state, si, depth, β, β_max / guidance, η,
                active_next & rr_active & (β_max != 0),
            )
            rr_continue = sampler.next_1d() < rr_probability
            if dr.hint(self.observer is not None, mode="scalar"):
                self.observer.survival(
                    depth, β, β_max / guidance, η, dr.select(rr_active, rr_probability, 1),
                    active_next,
                )
            β[rr_active] *= dr.rcp(rr_probability)
            active = active_next & (~rr_active | rr_continue) & (β_max != 0)

            pi = self.query.closest(scene, ray, coherent=False, active=active)
            scatter_count += dr.select(active, 1, 0)
            if dr.hint(self.observer is not None, mode="scalar"):
                self.observer.segment(prev_si.p, ray(pi.t), active & pi.is_valid())

        if dr.hint(self.observer is not None, mode="scalar"):
            self.observer.end(L)
        return PathSample(
            dr.select(valid, L, 0), valid, scatter_count, shadow_count, connection_count
        )

    def _add_emission(self, state, scene, L, β, si, prev_si, prev_bsdf_pdf, prev_bsdf_delta):
        """Adds the light that the BSDF sample of the previous vertex ran into."""
        ds = mi.DirectionSample3f(scene, si, prev_si)
        is_connectable = ~prev_bsdf_delta & (ds.emitter != None)  # noqa: E711
        em_pdf, state = self.next_event.pdf(state, scene, prev_si, si, ds, is_connectable)
        mis = power_heuristic(prev_bsdf_pdf, em_pdf)
        return dr.fma(β, ds.emitter.eval(si, prev_bsdf_pdf > 0) * mis, L), state

    def _sample_emitter(self, connects: bool, state, scene, sampler, si, active):
        if not connects:
            sampler.next_2d()  # the numbers that follow are those of `path`
            return dr.zeros(mi.DirectionSample3f), mi.Spectrum(0), state
        return self.next_event.sample(state, scene, sampler, si, active)

    def _shadow_roulette(self, state, choice, sampler, si, ds, unoccluded, active):
        """Lets the shadow test's decision drop connections; the survivors weigh 1/p."""
        p, state = self.shadow_test.probability(state, choice, si, ds, active)
        if p is None:
            return unoccluded, active, state
        survives = sampler.next_1d() < p
        # p > 0 wherever a lane survives: the random number is not negative
        return unoccluded * dr.select(survives, dr.rcp(p), 0), active & survives, state

    @dr.syntax
    def _skip_emitters(self, scene, ray, pi, active):
        """The first surface behind the area lights that a camera ray meets, and the ray from the
        last of these lights, to which that intersection belongs."""
        ray = mi.Ray3f(ray)
        on_emitter = active & pi.is_valid() & (pi.shape.emitter() != None)  # noqa: E711
        while on_emitter:
            ray = self.query.interaction(pi, ray).spawn_ray(ray.d)
            pi = self.query.closest(scene, ray, coherent=True, active=on_emitter)
            on_emitter &= pi.is_valid() & (pi.shape.emitter() != None)  # noqa: E711
        return ray, pi


def _emitters_can_be_hit(scene: mi.Scene) -> bool:
    """Is there a light that a scattered ray can run into?"""
    delta = mi.EmitterFlags.DeltaPosition | mi.EmitterFlags.DeltaDirection
    return any(not (int(e.flags()) & int(delta)) for e in scene.emitters())
