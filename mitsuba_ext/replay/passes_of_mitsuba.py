"""The passes in which Mitsuba's own integrators render."""

from __future__ import annotations

from dataclasses import fields

import drjit as dr
import mitsuba as mi

from ..rendering import camera
from ..rendering.plan import RenderPlan
from ..rendering.seed_passes import pass_length, pass_seed


class _Plan(RenderPlan):
    """Passes of equal length, and a shorter one for the rest."""

    def pass_length(self, samples: int, most_lanes: int = 0) -> int:
        return min(self.limit, samples)


class _OfMitsuba:
    """Mixed into a :class:`Job`, to take the samples of one of Mitsuba's integrators."""

    #: Whether all samples are taken in one pass.
    is_one_pass = False

    def __init__(self, integrator, request, *arguments) -> None:
        super().__init__(integrator, request, *arguments)
        plan = self.plan
        limit = plan.spp if self.is_one_pass else pass_length(self.sensor)
        if plan.structured and plan.spp > min(limit, plan.limit):
            raise NotImplementedError(
                f"{plan.spp} samples per pixel of Mitsuba's own integrators with a structured "
                f"sampler cannot be replayed, but {min(limit, plan.limit)} can: use the "
                f'"independent" sampler, or an integrator such as "composed_path"'
            )
        if not plan.structured:
            values = {field.name: getattr(plan, field.name) for field in fields(plan)}
            self.plan = _Plan(**{**values, "limit": limit})

    def _seed(self, sampler, index, spp, pixels) -> None:
        seed = pass_seed(self.request.seed, self.statistics.passes)
        camera.tell_film(sampler, self.film, getattr(pixels, "start", 0))
        sampler.seed(dr.opaque(mi.UInt32, seed), self._lanes(spp, pixels))


class InPasses(_OfMitsuba):
    """Passes of the lengths and the seeds of
    :class:`~mitsuba_ext.rendering.seed_passes.SeedPasses`."""


class InOnePass(_OfMitsuba):
    """One pass, as in ``mi.render``."""

    is_one_pass = True
