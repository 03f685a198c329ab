"""Connecting the first vertex of a path to many points of lights, from a weighted set.

Source: Guo, PhD thesis, section 4.5.2.4.
"""

from __future__ import annotations

import drjit as dr
import mitsuba as mi

from ...transport.heroes import Heroes
from ...transport.mis import power_heuristic
from ...transport.path_decisions import EmitterSampling, SceneQuery
from ..weighted_sets import WeightedSets


class ManyConnections(EmitterSampling):
    """Mitsuba's choice of lights, for whose numbers a path's first vertex draws a whole set. The
    BSDF sample that is taken there has its share by multiple importance sampling, as one sample
    besides so many.

    Parameters:
        sets: Of two dimensions.
    """

    gathers = True

    def __init__(self, sets: WeightedSets) -> None:
        self._sets, self._count = sets, dr.opaque(mi.UInt32, sets.count)

    @dr.syntax
    def gather(
        self,
        scene: mi.Scene,
        sampler: mi.Sampler,
        query: SceneQuery,
        ctx: mi.BSDFContext,
        heroes: Heroes,
        si: mi.SurfaceInteraction3f,
        bsdf: mi.BSDFPtr,
        active: mi.Bool,
    ) -> tuple[mi.Spectrum, mi.UInt32]:
        """The light that reaches ``si`` and is scattered to the camera, and the number of shadow
        rays that were traced for it."""
        number = self._sets.choose(sampler.next_1d())
        shift = sampler.next_2d()
        total, shadow_count, index = mi.Spectrum(0), mi.UInt32(0), mi.UInt32(0)
        count = mi.Float(self._count)
        active = mi.Bool(active)
        while active:
            u, weight = self._sets.draw(number, shift, index, active)
            ds, em_weight = scene.sample_emitter_direction(si, u, False, active)
            wo = si.to_local(ds.d)
            bsdf_value, bsdf_pdf = bsdf.eval_pdf(ctx, si, wo, active)
            # At the first vertex all wavelengths are there, and what begins here has no past
            bsdf_value = heroes.connect(heroes.begin(), bsdf_value, bsdf, si, wo)
            bsdf_value = si.to_world_mueller(bsdf_value, -wo, si.wi)
            mis = dr.select(ds.delta, 1, power_heuristic(count * ds.pdf, bsdf_pdf))
            contribution = bsdf_value * em_weight * (mis * weight)
            is_tested = active & (ds.pdf != 0) & (dr.max(dr.abs(contribution)) > 0)
            total[is_tested & ~query.occluded(scene, si, ds, is_tested)] += contribution
            shadow_count += dr.select(is_tested, 1, 0)
            index += 1
            active &= index < self._count
        return total / count, shadow_count

    # ---- The walk's own connections: from the second vertex on ----

    def begin(self, sampler, ray):
        return mi.UInt32(0)

    def sample(self, vertex, scene, sampler, si, active):
        active = active & (vertex > 0)
        ds, weight, _state = super().sample((), scene, sampler, si, active)
        ds.pdf = dr.select(vertex > 0, ds.pdf, 0)
        return ds, dr.select(vertex > 0, weight, 0), vertex + 1

    def pdf(self, vertex, scene, ref, si, ds, active):
        pdf, _state = super().pdf((), scene, ref, si, ds, active)
        return pdf * dr.select(vertex == 1, mi.Float(self._count), 1), vertex
