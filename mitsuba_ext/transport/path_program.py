"""What an estimator does along a path besides gathering radiance. It keeps the *history* of the
path; from the history it computes MIS weights and the probability that the path goes on; and it
adds the light of other subpaths.

One object does all of this because all of it reads the same history. Dr.Jit's loops see only local
variables: the history is therefore part of the :class:`.PathState`, and methods return a new one.
"""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi

from .path_decisions import Roulette, Weights
from .vertex import MediumVertex, PathState, Vertex


class Subpaths:
    """Subpaths that bring light to the vertices of a path: light paths that another walk has
    stored."""

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
        """The radiance that they add along the segment that ends at the surface ``si``, throughput
        included. ``inside`` is the state of the path in participating media."""
        return 0.0


class PathProgram:
    """Follows paths for an estimator. This program is for Mitsuba's ``path``: it needs no history,
    leaves MIS weights and Russian roulette to the decisions of the walk, and adds no code to the
    kernel.

    Attributes:
        subpaths: The other subpaths; ``None`` if there are none.
        ends_early: Whether :meth:`survival` may end paths before ``rr_depth``.
        weighs_transmittance: Whether MIS weights contain the probability with which a path passes
            through homogeneous media. :meth:`connection` then receives the density of connections
            divided by this probability.
        connects_all: Whether vertices in media are connected to lights even if the medium switches
            that off.
    """

    subpaths: Subpaths | None = None
    ends_early = weighs_transmittance = connects_all = False

    # ---- The history ----

    def begin(self, ray: mi.Ray3f) -> Any:
        """The history before the first vertex."""
        return None

    def arrive(
        self, path: PathState, si: mi.SurfaceInteraction3f, in_medium: MediumVertex | None
    ) -> Any:
        """The history at the vertex ``si``. ``path`` has the history that :meth:`leave` returned at
        the previous vertex. ``in_medium`` is the part of the vertex that concerns media."""
        return path.history

    def leave(self, vertex: Vertex, bs: mi.BSDFSample3f) -> Any:
        """The history behind ``vertex``, in the direction ``bs`` that was sampled there."""
        return vertex.path.history

    def known(
        self, vertex: Vertex, bs: mi.BSDFSample3f, β: mi.Spectrum, history: Any, active: mi.Bool
    ) -> tuple[mi.Spectrum | None, Any]:
        """The radiance that is already known in the direction in which a path leaves ``vertex``,
        throughput included, and the history behind it, which may exclude the known radiance from
        the rest of the path. ``None`` if nothing is known anywhere.

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
        """The MIS weight of light at ``si`` that the path has hit in the direction ``ds``.

        Parameters:
            weights: The decision of the walk, for paths that only scattering and connections find.
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
        """The MIS weight of a connection to the light sample ``ds``.

        Parameters:
            weights: See :meth:`emission`.
            pdf: Density of ``ds``, times the number of connections.
            scattering_pdf: Density with which scattering finds it.
        """
        return weights.connection(ds, pdf, scattering_pdf)

    def worth(self, vertex: Vertex, ds: mi.DirectionSample3f) -> mi.Float | float:
        """A factor for the light of a connection, for programs in which not all light counts
        equally. :meth:`emission` contains this factor."""
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
            late: Whether the path has reached ``rr_depth``. If not, the probability is used only
                with ``ends_early``.
        """
        return roulette.survival(state, vertex, path, active)


class EndingProgram(PathProgram):
    """The base of programs that may end paths before ``rr_depth``. By itself it ends none: paths
    survive up to that depth, and from there on with the probability that the walk's decision
    gives."""

    ends_early = True

    def survival(self, roulette, state, vertex, path, late, active):
        survival, state = super().survival(roulette, state, vertex, path, late, active & late)
        return dr.select(late, survival, 1), state
