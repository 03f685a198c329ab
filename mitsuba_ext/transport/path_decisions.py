"""The decisions of a random walk. These base classes decide as Mitsuba's ``path`` does, and define
the methods that a replacement overrides. They add no code to the kernel, except for shadow rays to
lights at infinity.

Dr.Jit's loops see only local variables. Whatever a decision changes from one bounce to the next is
therefore a *state* that its methods take and return; its attributes are read-only during the walk.
``None`` is the state of a decision that remembers nothing.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi

from .bsdfs import eval_and_sample_bsdf, eval_bsdf
from .mis import Heuristic, power_heuristic
from .scene_query import SceneQuery as SceneQuery  # one of the decisions
from .vertex import PathState, Vertex


class DirectionSamples:
    """The primary samples that choose the lobe and the direction of a BSDF sample. This class draws
    uniform ones.

    Attributes:
        gives_directions: Whether the two numbers for a vertex in a medium are the direction itself
            (:func:`.media.direction_at`), and not primary samples of the phase function.
    """

    gives_directions = False

    def begin(self, sampler: mi.Sampler, ray: mi.Ray3f, pixel: mi.UInt32 | None) -> Any:
        """The state before the first bounce of paths that begin in ``pixel`` of the film."""
        return None

    def draw(
        self, state: Any, sampler: mi.Sampler, vertex: Vertex, active: mi.Bool
    ) -> tuple[mi.Float, mi.Point2f, mi.Float | float, Any]:
        """The number that chooses the lobe, the two numbers that choose the direction, the factor
        for the throughput (1 / density of the numbers), and the new state."""
        return sampler.next_1d(), sampler.next_2d(), 1.0, state


class Scattering:
    """The direction in which a path continues. This class samples the BSDF.

    A replacement can mix in another distribution of directions. It must then return the densities
    of the mixture, because MIS weights of connections are computed from them.
    """

    def begin(self, sampler: mi.Sampler, ray: mi.Ray3f) -> Any:
        """The state before the first bounce."""
        return None

    def sample(
        self,
        state: Any,
        ctx: mi.BSDFContext,
        vertex: Vertex,
        wo: mi.Vector3f,
        sample_1: mi.Float,
        sample_2: mi.Point2f,
    ) -> tuple[mi.Spectrum, mi.Float, mi.BSDFSample3f, mi.Spectrum, Any]:
        """Samples a direction, and evaluates the BSDF in another one.

        Parameters:
            vertex: The vertex. ``vertex.lobes`` are set, if they are wanted and the BSDF alone
                chooses the direction.
            wo: The other direction (local, towards the light of a connection).
            sample_1, sample_2: Uniform numbers.

        Returns:
            The BSDF's value for ``wo`` (cosine included), and the density with which this decision
            samples ``wo``; the sampled direction, with its density; value / density of the sampled
            direction; the new state.
        """
        found = eval_and_sample_bsdf(
            vertex.bsdf, ctx, vertex.si, wo, sample_1, sample_2, vertex.lobes
        )
        return *found, state

    def eval_pdf(
        self, state: Any, ctx: mi.BSDFContext, vertex: Vertex, wo: mi.Vector3f, active: mi.Bool
    ) -> tuple[mi.Spectrum, mi.Float]:
        """The first two results of :meth:`sample` alone; ``state`` is the state before the call of
        :meth:`sample`."""
        return eval_bsdf(vertex.bsdf, ctx, vertex.si, wo, active)


@dataclass
class LightNumbers:
    """The primary samples of one connection.

    Attributes:
        point: Chooses the point on the light (and the light, if ``choice`` is ``None``).
        choice: Chooses the light: ``None``, one number or two, according to ``choice_dimension`` of
            :class:`EmitterSampling`.
    """

    point: mi.Point2f
    choice: mi.Float | mi.Point2f | None = None


class EmitterSampling:
    """Chooses a light, and the point on it to connect to. This class chooses as Mitsuba does
    (uniformly, or by the emitters' ``sampling_weight``).

    At each vertex, the walk calls :meth:`visit` once, and passes its result, the *place*, to
    :meth:`sample` for each connection. What :meth:`density` needs at the next vertex is the state.

    Attributes:
        choice_dimension: How many random numbers choose the light. They are drawn before the
            numbers that choose a point on it.
    """

    choice_dimension = 0

    def begin(self, sampler: mi.Sampler, ray: mi.Ray3f, pixel: mi.UInt32 | None = None) -> Any:
        """The state before the first bounce of paths that begin in ``pixel`` of the film."""
        return None

    def visit(
        self, state: Any, scene: mi.Scene, si: mi.SurfaceInteraction3f, active: mi.Bool
    ) -> Any:
        """The place of the vertex ``si``: what :meth:`sample` and :meth:`remember` need there."""
        return None

    def sample(
        self,
        place: Any,
        scene: mi.Scene,
        numbers: LightNumbers,
        si: mi.SurfaceInteraction3f,
        active: mi.Bool,
    ) -> tuple[mi.DirectionSample3f, mi.Spectrum, Any]:
        """A direction sample towards a light, its radiance / pdf (visibility not tested), and the
        choice that shadow tests and observers receive. ``place`` is from :meth:`visit`."""
        ds, weight = scene.sample_emitter_direction(si, numbers.point, False, active)
        return ds, weight, place

    def remember(
        self, place: Any, scene: mi.Scene, d: mi.Vector3f, pdf: mi.Float, active: mi.Bool
    ) -> Any:
        """The state of a path that leaves the vertex of ``place`` in the direction ``d`` (in world
        space), which scattering chose with the density ``pdf``."""
        return place

    def density(
        self,
        state: Any,
        scene: mi.Scene,
        ref: mi.Interaction3f,
        si: mi.SurfaceInteraction3f,
        ds: mi.DirectionSample3f,
        active: mi.Bool,
    ) -> mi.Float:
        """The solid angle density with which :meth:`sample`, at ``ref``, chooses the direction
        ``ds``, in which a BSDF sample has hit the light at ``si``. ``state`` is what
        :meth:`remember` returned at ``ref``."""
        return scene.pdf_emitter_direction(ref, ds, active)

    def probability(
        self,
        state: Any,
        scene: mi.Scene,
        ref: mi.Interaction3f,
        emitter: mi.UInt32,
        active: mi.Bool,
    ) -> mi.Float:
        """The probability with which :meth:`sample`, at ``ref``, chooses an emitter that is a
        single point or direction, by its number in ``scene.emitters()``. ``state`` is what
        :meth:`remember` returned at ``ref``."""
        return scene.pdf_emitter(emitter, active)


class NoConnections(EmitterSampling):
    """Connects to no light: only BSDF samples find light."""

    def sample(self, place, scene, numbers, si, active):
        return dr.zeros(mi.DirectionSample3f), mi.Spectrum(0), place

    def density(self, state, scene, ref, si, ds, active):
        return mi.Float(0)

    def probability(self, state, scene, ref, emitter, active):
        return mi.Float(0)


class ConnectionCount:
    """The number of points on lights to which a vertex is connected. Here it is one.

    Attributes:
        first, later: Number of connections of a path's first vertex, and of each later one. With 0,
            vertices are still connected to lights that no BSDF sample can hit (points and
            directions).
    """

    first, later = 1, 1

    def weight(self, depth: mi.UInt32) -> mi.Float | float:
        """The number of connections of a vertex at ``depth``, for MIS weights."""
        if self.first == self.later == 1:
            return 1.0
        first, later = (dr.opaque(mi.Float, n) for n in (self.first, self.later))
        return dr.select(depth == 0, first, later)

    def begin(self, sampler: mi.Sampler, choice_dimension: int) -> Any:
        """Chooses the set of numbers of a vertex that has more than one connection."""
        raise NotImplementedError

    def numbers(
        self, chosen: Any, index: mi.UInt32, choice_dimension: int, active: mi.Bool
    ) -> tuple[LightNumbers, mi.Float | float]:
        """The numbers of connection ``index``, and their weight."""
        raise NotImplementedError


class Weights:
    """The MIS weights of the two ways in which a path finds light: connections to lights, and
    scattered rays that hit lights.

    Parameters:
        heuristic: The MIS heuristic for these two.
    """

    def __init__(self, heuristic: Heuristic = power_heuristic) -> None:
        self._heuristic = heuristic

    def emission(self, scattering_pdf: mi.Float, pdf: mi.Float) -> mi.Float:
        """The weight of light that scattering has found with the density ``scattering_pdf``.
        ``pdf`` is the density with which connections find it, times their number."""
        return self._heuristic(scattering_pdf, pdf)

    def connection(
        self, ds: mi.DirectionSample3f, pdf: mi.Float, scattering_pdf: mi.Float
    ) -> mi.Float:
        """The weight of a connection to the light sample ``ds``. ``pdf`` is its density times the
        number of connections, ``scattering_pdf`` the density with which scattering finds it."""
        return dr.select(ds.delta, 1, self._heuristic(pdf, scattering_pdf))


class ScatteringAlone(Weights):
    """Uses scattering alone: connections have weight 0, except to light that scattering cannot
    find."""

    def emission(self, scattering_pdf, pdf):
        return dr.select(scattering_pdf > 0, mi.Float(1), 0)

    def connection(self, ds, pdf, scattering_pdf):
        return dr.select(ds.delta | ~(scattering_pdf > 0), mi.Float(1), 0)


class ConnectionsAlone(Weights):
    """Uses connections alone: light that a path hits has weight 0, except where no connection can
    find it."""

    def emission(self, scattering_pdf, pdf):
        return dr.select(pdf > 0, mi.Float(0), 1)

    def connection(self, ds, pdf, scattering_pdf):
        return mi.Float(1)


class SubpathSelection:
    """The vertices of other subpaths to which a vertex is connected. This class stands for a
    uniform choice. Replacements choose a region of surfaces first, then one of the vertices in it
    uniformly; the methods below are called for replacements only.

    Attributes:
        count: Number of regions; 0 where there are none.
    """

    count = 0

    def region(self, si: mi.SurfaceInteraction3f, active: mi.Bool) -> mi.UInt32:
        """The region of a vertex of either subpath; ``si.wi`` determines the side of the
        surface."""
        raise NotImplementedError

    def choose(
        self, sample: mi.Point2f, region: mi.UInt32, active: mi.Bool
    ) -> tuple[mi.UInt32, mi.Float]:
        """The region of the vertex to which a vertex in ``region`` is connected, and the
        probability of choosing that region."""
        raise NotImplementedError

    def expected(self, region: mi.UInt32, chosen: mi.UInt32, active: mi.Bool) -> mi.Float:
        """For MIS weights: how often, on average, a vertex in ``region`` is connected to a given
        vertex in the region ``chosen``, multiplied by the number of other subpaths. This is the
        probability of choosing the region / the number of vertices that a subpath has there."""
        raise NotImplementedError

    def by_power(self, power: mi.Float) -> SubpathSelection:
        """The selection for given vertices of other subpaths: it chooses regions by the actual
        brightness of these vertices, not by their average. It has no :meth:`expected`.

        Parameters:
            power: The sum of the brightness of these vertices in each region; regions without any
                are not chosen.
        """
        raise NotImplementedError


class ShadowTest:
    """Decides whether the shadow ray of a connection is traced."""

    def begin(self, sampler: mi.Sampler, ray: mi.Ray3f) -> Any:
        """The state before the first bounce."""
        return None

    def probability(
        self,
        state: Any,
        choice: Any,
        si: mi.SurfaceInteraction3f,
        ds: mi.DirectionSample3f,
        active: mi.Bool,
    ) -> tuple[mi.Float | None, Any]:
        """The probability, in (0, 1], of testing the connection from ``si`` to ``ds.p``, and the
        new state. A probability of ``None`` means always, and leaves the roulette out of the
        kernel. ``choice`` is what the next event decision returned about its choice."""
        raise NotImplementedError


class AlwaysTest(ShadowTest):
    """Every shadow ray is traced."""

    def probability(self, state, choice, si, ds, active):
        return None, state


#: The largest survival probability of Mitsuba's ``path``.
LARGEST_PROBABILITY = 0.95


class Roulette:
    """Russian roulette by throughput, as in Mitsuba's ``path``."""

    def begin(self, sampler: mi.Sampler, ray: mi.Ray3f, pixel: mi.UInt32 | None) -> Any:
        """The state before the first bounce."""
        return None

    def survival(
        self, state: Any, vertex: Vertex, path: PathState, active: mi.Bool
    ) -> tuple[mi.Float, Any]:
        """The probability, in (0, 1] where ``active``, with which a path leaves ``vertex`` in the
        direction that was sampled there, and the new state. ``path`` is the state of the path after
        ``vertex``: its depth is the depth of the next vertex. The walk divides the throughput of
        paths that survive by the probability."""
        return dr.minimum(unguided_throughput(path), LARGEST_PROBABILITY), state


def unguided_throughput(path: PathState) -> mi.Float:
    """The largest component of the throughput, without its sampling weight and the scaling by
    refraction. The sampling weight says nothing about the importance of a path: it is small where
    guided samples are dense, and 4 where a hero represents four wavelengths."""
    return dr.max(path.β) / path.sampling_weight * dr.square(path.η)
