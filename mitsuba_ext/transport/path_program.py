"""What an estimator does along a path besides gathering radiance: it knows the *history* of the
path, weighs what the path finds by it, ends the path by it, and adds the light of other subpaths.

One object does all of this, since all of it reads the same history. Dr.Jit's loops see local
variables only: the history is part of the :class:`.PathState`, and the methods return a new one.
"""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi

from .path_decisions import Roulette, Weights
from .vertex import PathState, Vertex


class Subpaths:
    """Other subpaths, which bring light to the vertices of a path: light paths that another walk
    has stored."""

    def gather(
        self, scene: mi.Scene, sampler: mi.Sampler, vertex: Vertex, active: mi.Bool
    ) -> tuple[mi.Spectrum, mi.UInt32]:
        """The radiance that they add at a vertex of the path, throughput included, and the number
        of shadow rays."""
        raise NotImplementedError

    def along(
        self,
        sampler: mi.Sampler,
        ray: mi.Ray3f,
        si: mi.SurfaceInteraction3f,
        inside: Any,
        path: PathState,
        active: mi.Bool,
    ) -> mi.Spectrum | float:
        """The radiance that they add on the way of a path to the surface ``si``, throughput
        included, where the state of the path in participating media is ``inside``."""
        return 0.0


class PathProgram:
    """Follows paths for an estimator. This one is for Mitsuba's ``path``: it needs no history,
    leaves weights and Russian roulette to the decisions of the walk, and adds no code to the
    kernel.

    Attributes:
        subpaths: The other subpaths; ``None`` if there are none.
        ends_early: Whether :meth:`survival` may end paths before ``rr_depth``.
    """

    subpaths: Subpaths | None = None
    ends_early = False

    # ---- The history ----

    def begin(self, ray: mi.Ray3f) -> Any:
        """The history before the first vertex."""
        return None

    def arrive(self, path: PathState, si: mi.SurfaceInteraction3f) -> Any:
        """The history at the vertex ``si``; ``path`` has the one of :meth:`leave` at the last
        vertex."""
        return path.history

    def leave(self, vertex: Vertex, bs: mi.BSDFSample3f) -> Any:
        """The history behind ``vertex``, in the direction ``bs`` that was sampled there."""
        return vertex.path.history

    def known(
        self, vertex: Vertex, bs: mi.BSDFSample3f, β: mi.Spectrum, history: Any, active: mi.Bool
    ) -> tuple[mi.Spectrum | None, Any]:
        """The radiance that is known of the direction in which a path leaves ``vertex``, throughput
        included, and the history behind it, which may exclude what is known from the rest of the
        path. ``None`` if nothing is known anywhere.

        Parameters:
            β: The throughput in that direction.
            history: From :meth:`leave`.
        """
        return None, history

    # ---- MIS weights ----

    def emission(
        self,
        weights: Weights,
        scene: mi.Scene,
        si: mi.SurfaceInteraction3f,
        ds: mi.DirectionSample3f,
        path: PathState,
        pdf: mi.Float,
    ) -> mi.Float:
        """The weight of light at ``si`` that the path has hit in the direction ``ds``.

        Parameters:
            weights: The decision of the walk, for paths that scattering and connections alone find.
            pdf: The density with which connections find the light, times their number.
        """
        return weights.emission(path.arrival.pdf, pdf)

    def connection(
        self,
        weights: Weights,
        scene: mi.Scene,
        vertex: Vertex,
        ds: mi.DirectionSample3f,
        pdf: mi.Float,
        scattering_pdf: mi.Float,
    ) -> mi.Float:
        """The weight of a connection to the light sample ``ds``.

        Parameters:
            weights: See :meth:`emission`.
            pdf: Density of ``ds``, times the number of connections.
            scattering_pdf: Density with which scattering finds it.
        """
        return weights.connection(ds, pdf, scattering_pdf)

    def worth(self, vertex: Vertex, ds: mi.DirectionSample3f) -> mi.Float | float:
        """How much the light of a connection counts, where not all light counts the same.
        :meth:`emission` contains this factor."""
        return 1.0

    # ---- Where paths end ----

    def survival(
        self,
        roulette: Roulette,
        state: Any,
        vertex: Vertex,
        path: PathState,
        late: mi.Bool,
        active: mi.Bool,
    ) -> tuple[mi.Float, Any]:
        """The probability with which a path goes on, and the new state of the roulette; see
        :meth:`.Roulette.survival`.

        Parameters:
            roulette, state: The decision of the walk, and its state.
            late: Where the path has reached ``rr_depth``. Where it has not, the probability counts
                only with ``ends_early``.
        """
        return roulette.survival(state, vertex, path, active)


class EndingProgram(PathProgram):
    """A program that may end paths before ``rr_depth``. This one does not: paths survive up to that
    depth, and from there on with the probability of the walk's decision."""

    ends_early = True

    def survival(self, roulette, state, vertex, path, late, active):
        survival, state = super().survival(roulette, state, vertex, path, late, active & late)
        return dr.select(late, survival, 1), state
