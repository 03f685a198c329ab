"""Sampling an environment through portals.

Source: B. Bitterli, J. Novák, W. Jarosz, *Portal-Masked Environment Map Sampling*, Computer
Graphics Forum 34(4), 2015.
"""

from __future__ import annotations

import drjit as dr
import mitsuba as mi

from ...scene.portals import portals
from ...transport.path_decisions import EmitterSampling
from .portal_maps import PortalMaps

#: No portal.
_NONE = 0xFFFFFFFF


class PortalSampling(EmitterSampling):
    """Samples a share of the connections to the environment through portals: chooses a portal by
    the light that comes through it, then a direction in proportion to the emission. All other
    connections are sampled as Mitsuba does.

    Parameters:
        scene: A scene with an environment emitter and portals.
        share: The share of the connections to the environment that go through portals.
    """

    choice_dimension = 1

    def __init__(self, scene: mi.Scene, share: float) -> None:
        self._maps = PortalMaps(scene, portals(scene))
        self._count = dr.opaque(mi.UInt32, self._maps.count)
        self._share = dr.opaque(mi.Float, share)
        emitters = scene.emitters()
        self._is_alone = len(emitters) == 1
        self._index = emitters.index(scene.environment())
        self._pointer = self._maps.directions.pointer

    def begin(self, sampler, ray, pixel=None) -> mi.Float64:
        return mi.Float64(0)

    @dr.syntax
    def visit(self, state, scene, si, active) -> mi.Float64:
        """The sum of the emission that is seen through each portal."""
        total, index = mi.Float64(0), mi.UInt32(0)
        while dr.hint(active & (index < self._count), label="portals"):
            total += self._maps.window(index, si.p, active).total
            index += 1
        return total

    def sample(self, place, scene, numbers, si, active):
        if self._is_alone:
            inverse, number, to_sky = mi.Float(1), numbers.choice, mi.Bool(active)
            emitter = self._pointer
        else:
            index, inverse, number = scene.sample_emitter(numbers.choice, active)
            to_sky = active & (index == self._index)
            emitter = dr.gather(mi.EmitterPtr, scene.emitters_dr(), index, active)
        by_portal = to_sky & (place > 0) & (number < self._share)
        d, chosen, emitted = self._through_portal(
            si.p, mi.Float64(number / self._share) * place, numbers.point, by_portal
        )
        is_other = active & ~by_portal
        ds, weight = emitter.sample_direction(si, numbers.point, is_other)
        ds.emitter = mi.EmitterPtr(emitter)
        value = dr.select(is_other, weight * ds.pdf, 0)
        directions = self._maps.directions
        portal_ds = directions.sample(si, d)
        portal_ds.pdf = directions.emitter.pdf_direction(si, portal_ds, by_portal)
        ds = dr.select(by_portal, portal_ds, ds)
        value = dr.select(by_portal, directions.radiance(si, d, by_portal), value)
        # At the edge of the chosen portal, rounding could exclude the sampled direction
        emitted = dr.select(by_portal, emitted, 0)
        emitted += self._emitted(si.p, ds.d, chosen, to_sky & (place > 0))
        pdf = self._mixed(ds.pdf, emitted, place, to_sky) / inverse
        ds.pdf = dr.select(active & dr.isfinite(pdf), pdf, 0)
        return ds, dr.select(ds.pdf > 0, value / ds.pdf, 0), place

    def remember(self, place, scene, d, pdf, active) -> mi.Float64:
        return mi.Float64(place)

    def density(self, state, scene, ref, si, ds, active):
        whole = scene.pdf_emitter_direction(ref, ds, active)
        to_sky = active & (ds.emitter == self._pointer)
        emitted = self._emitted(ref.p, ds.d, mi.UInt32(_NONE), to_sky & (state > 0))
        if not self._is_alone:
            emitted *= mi.Float64(scene.pdf_emitter(mi.UInt32(self._index), active))
        return dr.select(active, self._mixed(whole, emitted, state, to_sky), 0)

    def _mixed(
        self, ordinary: mi.Float, emitted: mi.Float64, total: mi.Float64, to_sky: mi.Bool
    ) -> mi.Float:
        """The density of the mixture of Mitsuba's choice and portals."""
        is_mixed = to_sky & (total > 0)
        by_portal = mi.Float(emitted / dr.select(is_mixed, total, 1))
        return dr.lerp(ordinary, by_portal, dr.select(is_mixed, self._share, 0))

    @dr.syntax
    def _through_portal(
        self, p: mi.Point3f, goal: mi.Float64, point: mi.Point2f, active: mi.Bool
    ):
        """A direction, the chosen portal, and the emission seen through it there. ``goal`` is a
        random fraction of the result of :meth:`visit`."""
        index, chosen = mi.UInt32(0), mi.UInt32(_NONE)
        while dr.hint(active & (index < self._count) & (goal >= 0), label="choose a portal"):
            seen = self._maps.window(index, p, active).total
            # Rounding may leave a positive rest after the last visible portal
            chosen = dr.select(seen > 0, index, chosen)
            goal -= seen
            index += 1
        active = active & (chosen < self._count)
        d, emitted = self._maps.sample(self._maps.window(chosen, p, active), point, active)
        return d, chosen, emitted

    @dr.syntax
    def _emitted(
        self, p: mi.Point3f, d: mi.Vector3f, skipped: mi.UInt32, active: mi.Bool
    ) -> mi.Float64:
        """The emission in the direction ``d``, summed over the portals through which it is seen,
        without the ``skipped`` one."""
        sum, index = mi.Float64(0), mi.UInt32(0)
        while dr.hint(active & (index < self._count), label="densities"):
            sum += self._maps.emitted(index, p, d, active & (index != skipped))
            index += 1
        return sum
