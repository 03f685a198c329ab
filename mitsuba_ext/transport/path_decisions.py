"""The decisions that Mitsuba's ``path`` takes. They leave no code of their own in the kernel, but
for shadow rays to lights at infinity."""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi

#: With which a path that loses nothing survives: Mitsuba's.
LARGEST_PROBABILITY = 0.95


class DirectionSamples:
    """Which primary samples choose the lobe and the direction of a BSDF sample: uniform ones."""

    def begin(self, sampler: mi.Sampler, ray: mi.Ray3f, pixel: mi.UInt32 | None) -> Any:
        """The state before the first bounce of paths that begin in ``pixel`` of the film."""
        return ()

    def draw(
        self,
        state: Any,
        sampler: mi.Sampler,
        si: mi.SurfaceInteraction3f,
        depth: mi.UInt32,
        active: mi.Bool,
    ) -> tuple[mi.Float, mi.Point2f, mi.Float | float, Any]:
        """The lobe's number, the direction's numbers, the factor by which the throughput is to be
        multiplied (1 / density of the numbers), and the new state."""
        return sampler.next_1d(), sampler.next_2d(), 1.0, state


class EmitterSampling:
    """Which point of which light to connect to: Mitsuba's choice (uniform, or by the emitters'
    ``sampling_weight``).

    Attributes:
        gathers: Has it a method ``gather``, which connects a path's first vertex to many points?
    """

    gathers = False

    def begin(self, sampler: mi.Sampler, ray: mi.Ray3f) -> Any:
        """The state before the first bounce."""
        return ()

    def sample(
        self,
        state: Any,
        scene: mi.Scene,
        sampler: mi.Sampler,
        si: mi.SurfaceInteraction3f,
        active: mi.Bool,
    ) -> tuple[mi.DirectionSample3f, mi.Spectrum, Any]:
        """A direction sample towards a light, its radiance / pdf (visibility not tested), and the
        new state."""
        ds, weight = scene.sample_emitter_direction(si, sampler.next_2d(), False, active)
        return ds, weight, state

    def pdf(
        self,
        state: Any,
        scene: mi.Scene,
        ref: mi.Interaction3f,
        si: mi.SurfaceInteraction3f,
        ds: mi.DirectionSample3f,
        active: mi.Bool,
    ) -> tuple[mi.Float, Any]:
        """The solid angle density with which :meth:`sample`, at ``ref``, gives the direction
        ``ds`` in which a BSDF sample ran into the light at ``si``, and the new state."""
        return scene.pdf_emitter_direction(ref, ds, active), state


class ShadowTest:
    """Whether the shadow ray of a connection is traced."""

    def begin(self, sampler: mi.Sampler, ray: mi.Ray3f) -> Any:
        """The state before the first bounce."""
        return ()

    def probability(
        self,
        state: Any,
        choice: Any,
        si: mi.SurfaceInteraction3f,
        ds: mi.DirectionSample3f,
        active: mi.Bool,
    ) -> tuple[mi.Float | None, Any]:
        """The probability, in (0, 1], of testing the connection from ``si`` to ``ds.p``, and the
        new state. ``choice`` is the state of the next event decision that made the connection.
        ``None`` means always, and leaves the roulette out of the kernel."""
        raise NotImplementedError


class AlwaysTest(ShadowTest):
    """Every shadow ray is traced."""

    def probability(self, state, choice, si, ds, active):
        return None, state


class Roulette:
    """With which probability a path goes on after a bounce."""

    def begin(self, sampler: mi.Sampler, ray: mi.Ray3f, pixel: mi.UInt32 | None) -> Any:
        """The state before the first bounce of paths that begin in ``pixel`` of the film."""
        return ()

    def probability(
        self,
        state: Any,
        si: mi.SurfaceInteraction3f,
        depth: mi.UInt32,
        throughput: mi.Spectrum,
        unguided: mi.Float,
        η: mi.Float,
        active: mi.Bool,
    ) -> tuple[mi.Float, Any]:
        """The probability, in (0, 1] where ``active``, with which a path leaves the vertex ``si``,
        and the new state.

        Parameters:
            depth: Of the vertex to which the path would go on; 1 after the first bounce.
            throughput: With the bounce at ``si``; what survives is divided by the probability.
            unguided: The largest component of the throughput, less what says nothing about its
                use: guided samples are dense where paths matter, and a hero stands for four.
            η: Product of the relative indices of refraction.
        """
        raise NotImplementedError


class ThroughputRoulette(Roulette):
    """Paths survive in proportion to their throughput."""

    def probability(self, state, si, depth, throughput, unguided, η, active):
        return dr.minimum(unguided * dr.square(η), LARGEST_PROBABILITY), state


class SceneQuery:
    """How a ray meets the scene."""

    def closest(
        self, scene: mi.Scene, ray: mi.Ray3f, coherent: bool, active: mi.Bool
    ) -> mi.PreliminaryIntersection3f:
        """The closest intersection. ``coherent`` is a hint that neighbouring rays are alike."""
        reorder = not coherent and dr.flag(dr.JitFlag.LoopRecord)
        return scene.ray_intersect_preliminary(
            ray, coherent=coherent, reorder=reorder, active=active
        )

    def interaction(
        self, pi: mi.PreliminaryIntersection3f, ray: mi.Ray3f
    ) -> mi.SurfaceInteraction3f:
        """Everything about an intersection that :meth:`closest` found."""
        return pi.compute_surface_interaction(ray, mi.RayFlags.All)

    def occluded(
        self,
        scene: mi.Scene,
        si: mi.SurfaceInteraction3f,
        ds: mi.DirectionSample3f,
        active: mi.Bool,
    ) -> mi.Bool:
        """Is there anything between ``si`` and the light that ``ds`` is about?"""
        return scene.ray_test(self.shadow_ray(scene, si, ds), active=active)

    def shadow_ray(
        self, scene: mi.Scene, si: mi.SurfaceInteraction3f, ds: mi.DirectionSample3f
    ) -> mi.Ray3f:
        """The ray from ``si`` to the light that ``ds`` is about."""
        ray = si.spawn_ray_to(ds.p)
        if any(mi.has_flag(e.flags(), mi.EmitterFlags.Infinite) for e in scene.emitters()):
            # Mitsuba puts ds.p behind the bounds of the scene, which it knows wrongly where
            # rectangles were merged (``bounds.py``): its shadow rays may end before a wall
            is_infinite = mi.has_flag(ds.emitter.flags(), mi.EmitterFlags.Infinite)
            ray.maxt = dr.select(is_infinite, dr.largest(mi.Float), ray.maxt)
        return ray
