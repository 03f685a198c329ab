"""Choosing a light among candidates, by the contribution of each without occlusion.

Sources: J. Talbot, D. Cline, P. Egbert, *Importance Resampling for Global Illumination*, EGSR 2005;
Cline, PhD dissertation, section 4.4.4 (whose Eq. 4.10 prints the weights inverted).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi

from ...scene.lights.environment_directions import EnvironmentDirections
from ...transport.bsdfs import eval_bsdf, sample_bsdf
from ...transport.heroes import Heroes
from ...transport.path_decisions import EmitterSampling, LightNumbers
from ...util.spectra import brightness

#: A lattice that is even for every number of points (the reciprocals of the plastic number), and
#: the golden ratio for a third number.
_STEP_X, _STEP_Y, _STEP_Z = 0.7548776662, 0.5698402910, 0.6180339887


@dataclass
class _Reservoir:
    """One of the candidates that were considered, chosen in proportion to their weights.

    Attributes:
        total: Sum of the weights.
        number: The rest of the random number that chooses, in [0, 1).
        ds: The chosen candidate. Its density is the density of the candidates, times their number.
        value: Its radiance.
        target: Its contribution if it is not occluded.
    """

    total: mi.Float
    number: mi.Float
    ds: mi.DirectionSample3f
    value: mi.Spectrum
    target: mi.Float


class ResampledLights(EmitterSampling):
    """Resampled importance sampling. Light samples and, where there is an environment, BSDF samples
    are the candidates of a connection. One of them, y, is chosen in proportion to f̂ / p: f̂ is its
    contribution without occlusion, p the density of all candidates together. Only to y, a shadow
    ray is traced. With its contribution f(y), the estimate is

        f(y) / f̂(y) · Σ f̂(x_i) / (M_l p_l(x_i) + M_b p_b(x_i)),

    for M_l light and M_b BSDF samples. That is unbiased for any f̂ that is positive where f is, as
    long as each single candidate has its density: they may depend on each other, and are points of
    a lattice that is shifted at random.

    **MIS.** The density of the chosen direction is unknown, and not needed: the expectation above
    holds for f times any weight w(y) as well, so that weights are unbiased if the weights of both
    techniques add up to one in each direction. Those of :class:`Weights` do, for any function that
    both evaluate in place of the density. Here it is the density of all candidates, M_l p_l + M_b
    p_b, which the choice improves upon.

    Parameters:
        scene: The scene whose emitters are chosen from, as Mitsuba does.
        candidates: The number of candidates, M_l + M_b.
    """

    choice_dimension = 2

    def __init__(self, scene: mi.Scene, candidates: int) -> None:
        has_environment = scene.environment() is not None
        self._environment = EnvironmentDirections(scene) if has_environment else None
        # The radiance of BSDF samples is known without a ray only if they leave the scene
        self._bsdf_count = candidates // 2 if has_environment else 0
        self._light_count = candidates - self._bsdf_count
        self._ctx = Heroes(scene).context()
        self._counts = dr.opaque(mi.UInt32, self._light_count), dr.opaque(
            mi.UInt32, self._bsdf_count
        )

    def begin(self, sampler, ray, pixel=None) -> mi.Float:
        return mi.Float(0)

    def remember(self, place, scene, d, pdf, active) -> mi.Float:
        return mi.Float(pdf)

    def density(self, state, scene, ref, si, ds, active):
        by_light = scene.pdf_emitter_direction(ref, ds, active)
        return dr.select(active, self._density(ds, by_light, state), 0)

    def probability(self, state, scene, ref, emitter, active):
        return self._light_count * scene.pdf_emitter(emitter, active)

    def _density(self, ds, by_light: mi.Float, by_bsdf: mi.Float) -> mi.Float:
        """M_l p_l + M_b p_b."""
        density = self._light_count * by_light
        if self._environment is None:
            return density
        found = (ds.emitter == self._environment.pointer) & ~ds.delta
        return density + dr.select(found, self._bsdf_count * by_bsdf, 0)

    @dr.syntax
    def sample(self, place, scene, numbers: LightNumbers, si, active):
        shift, lobe = numbers.point, numbers.choice.y
        bsdf = si.bsdf()
        reservoir = _Reservoir(
            mi.Float(0), mi.Float(numbers.choice.x), dr.zeros(mi.DirectionSample3f),
            mi.Spectrum(0), mi.Float(0),
        )  # fmt: skip
        light_count, bsdf_count = self._counts
        index = mi.UInt32(0)
        while dr.hint(active & (index < light_count), label="light candidates"):
            point = _turned(shift, index)
            ds, weight = scene.sample_emitter_direction(si, point, False, active)
            reservoir = self._consider(
                reservoir, bsdf, si, ds, weight * ds.pdf, active & (ds.pdf > 0)
            )
            index += 1
        while dr.hint(active & (index < light_count + bsdf_count), label="BSDF candidates"):
            bs, _weight = sample_bsdf(
                bsdf, self._ctx, si, _fraction(lobe + mi.Float(index) * _STEP_Z),
                _turned(shift, index), active,
            )  # fmt: skip
            is_smooth = active & (bs.pdf > 0)
            is_smooth &= ~mi.has_flag(bs.sampled_type, mi.BSDFFlags.Delta)
            is_smooth &= ~mi.has_flag(bs.sampled_type, mi.BSDFFlags.Null)
            ds, value = self._towards_environment(scene, si, si.to_world(bs.wo), is_smooth)
            reservoir = self._consider(reservoir, bsdf, si, ds, value, is_smooth)
            index += 1
        # The sum of all weights, per unit of the candidate's target: positive where it was chosen
        share = reservoir.total / reservoir.target
        is_chosen = active & (reservoir.total > 0) & dr.isfinite(share)
        ds = reservoir.ds
        ds.pdf = dr.select(is_chosen, ds.pdf, 0)
        return ds, dr.select(is_chosen, reservoir.value * share, 0), place

    def _towards_environment(self, scene, si, d, active):
        """A direction sample towards the environment, with Mitsuba's density, and its radiance."""
        if self._environment is None:
            return dr.zeros(mi.DirectionSample3f), mi.Spectrum(0)
        ds = self._environment.sample(si, d)
        ds.pdf = scene.pdf_emitter_direction(si, ds, active)
        return ds, self._environment.radiance(si, d, active)

    def _consider(self, reservoir: _Reservoir, bsdf, si, ds, value, active) -> _Reservoir:
        """The reservoir after a candidate: a direction with Mitsuba's density and its radiance."""
        f, by_bsdf = eval_bsdf(bsdf, self._ctx, si, si.to_local(ds.d), active)
        target = brightness(f * value)
        ds.pdf = self._density(ds, ds.pdf, by_bsdf)
        # Erratum of Eq. 4.10 (Cline): f / p, not p / f
        weight = target / ds.pdf
        weight = dr.select(active & (weight > 0) & dr.isfinite(weight), weight, 0)
        total = reservoir.total + weight
        # The rest of the number after one choice is stretched to [0, 1) for the next one
        probability = dr.select(weight > 0, weight / total, 0)
        is_taken = reservoir.number < probability
        number = reservoir.number - dr.select(is_taken, 0, probability)
        number /= dr.select(is_taken, probability, 1 - probability)
        return _Reservoir(
            total,
            dr.clip(number, 0, dr.one_minus_epsilon(mi.Float)),
            dr.select(is_taken, ds, reservoir.ds),
            dr.select(is_taken, value, reservoir.value),
            dr.select(is_taken, target, reservoir.target),
        )


def _turned(shift: mi.Point2f, index: mi.UInt32) -> mi.Point2f:
    """Point ``index`` of the lattice."""
    i = mi.Float(index)
    return mi.Point2f(_fraction(shift.x + i * _STEP_X), _fraction(shift.y + i * _STEP_Y))


def _fraction(x: Any) -> Any:
    return dr.minimum(x - dr.floor(x), dr.one_minus_epsilon(mi.Float))
