"""What a light path knows about itself so far: the *history* that an estimator needs at its
vertices, besides the throughput."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import mitsuba as mi

from ...transport.scene_query import SceneQuery
from ...transport.vertex import Vertex

if TYPE_CHECKING:
    from .emission import EmittedRay


@dataclass(frozen=True)
class StoredHistory:
    """How the history of a light path is stored with its vertices. This class stores nothing.

    Attributes:
        word_count: Number of 32-bit words. If there are any, the first one is 0 at vertices of
            caustics (:meth:`.VertexCache.is_caustic`).
        has_region: Whether the history has a ``region``, which is stored too.
    """

    word_count: int = 0
    has_region: bool = False

    def words(self, history: Any) -> list[mi.Float]:
        """The words."""
        return []

    def read(
        self, words: list[mi.Float], depth: mi.UInt32, region: mi.UInt32 | None
    ) -> Any:
        """The history of a vertex at ``depth``."""
        return None


class LightProgram:
    """Follows light paths for an estimator: it keeps their history from vertex to vertex. This
    program needs none.

    Attributes:
        stored: How the history is stored with a vertex.
        is_weighed: Whether light paths are combined with camera paths by MIS weights.
    """

    stored = StoredHistory()
    is_weighed = False

    def first(
        self,
        scene: mi.Scene,
        query: SceneQuery,
        emitted: EmittedRay,
        pi: mi.PreliminaryIntersection3f,
        active: mi.Bool,
    ) -> Any:
        """The history at the first vertex after the light, where ``emitted`` hits ``pi``."""
        return None

    def arrive(self, history: Any, vertex: Vertex, start: EmittedRay | None) -> Any:
        """The history at ``vertex``; ``history`` is from :meth:`leave` at the previous vertex, or
        from :meth:`first`. ``start`` is the ray with which the path began, in scenes with media."""
        return history

    def is_open(self, si: mi.SurfaceInteraction3f, d: mi.Vector3f) -> mi.Bool | bool:
        """Whether light paths may leave ``si`` in the local direction ``d``."""
        return True

    def leave(
        self,
        history: Any,
        vertex: Vertex,
        bs: mi.BSDFSample3f,
        reverse_pdf: mi.Float,
        passes: mi.Bool,
    ) -> Any:
        """The history behind ``vertex``, after the direction ``bs`` was sampled there.

        Parameters:
            history: From :meth:`arrive` at ``vertex``.
            reverse_pdf: Density of the reverse direction through the vertex, per solid angle.
            passes: Whether the vertex is not stored, or ``bs`` is from a delta lobe.
        """
        return history
