"""A random walk without participating media: what a walk asks about media, and the answers that add
nothing to the kernel. ``media.py`` overrides them."""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi

from .estimator import CameraRays
from .hidden_emitters import behind_emitters
from .path_decisions import SceneQuery
from .vertex import MediumVertex, PathState, Vertex


class NoMedia:
    """For scenes without media: everything is as in ``path``.

    Parameters:
        hide_emitters: Whether the environment is invisible to rays that nothing has scattered yet.
    """

    exist = False
    #: Whether camera rays are traced in packets, as in ``path``.
    coherent = True

    def __init__(self, hide_emitters: bool = False) -> None:
        self._hides = hide_emitters

    def begin(self, sampler, rays: CameraRays) -> Any:
        """The state of camera rays."""
        return None

    def launch(self, inside, β, sampler, rays: CameraRays, ray, active) -> tuple[mi.Ray3f, Any]:
        """``ray``, shortened to the distance at which a homogeneous medium scatters, and the state.
        ``rays`` are the camera rays of the paths, ``β`` is what a path carries along ``ray``."""
        return ray, inside

    def behind(
        self, query: SceneQuery, scene, ray, pi, active
    ) -> tuple[mi.Ray3f, mi.PreliminaryIntersection3f]:
        """See :func:`behind_emitters`."""
        return behind_emitters(query, scene, ray, pi, active)

    def fly(
        self, inside, sampler, ray, si, β, active
    ) -> tuple[mi.SurfaceInteraction3f, mi.Spectrum, MediumVertex | None]:
        """The next vertex of a path whose ``ray`` hits ``si``: at ``si``, or in a medium on the
        way; the throughput up to the vertex; and the part of the vertex that concerns media."""
        return si, β, None

    def sampling_weight(self, path: PathState, in_medium: MediumVertex | None) -> mi.Float:
        """The sampling weight of ``path`` at its next vertex, from :meth:`fly`."""
        return path.sampling_weight

    def meets(self, pi: mi.PreliminaryIntersection3f, inside) -> mi.Bool:
        """Whether a ray that was launched may have one more vertex."""
        return pi.is_valid()

    def arriving(self, β: mi.Spectrum, vertex: Vertex) -> mi.Spectrum:
        """The throughput ``β`` at a vertex, without the scattering coefficient of a medium."""
        return β

    def goes_on(self, vertex: Vertex, max_depth: int, active) -> tuple[mi.Bool, mi.Bool]:
        """Whether a path may leave ``vertex``, and whether ``vertex`` may be connected to
        lights."""
        goes_on = (vertex.depth + 1 < max_depth) & vertex.si.is_valid()
        return goes_on, goes_on & mi.has_flag(vertex.bsdf.flags(), mi.BSDFFlags.Smooth)

    def turns(self, vertex: Vertex, active) -> mi.Bool:
        """The ``active`` paths that may change their direction."""
        return active

    def scatter(self, vertex: Vertex, sample_1, sample_2, bs, weight, is_given=False):
        """The direction sample of ``vertex`` and its weight: in a medium from the phase function,
        elsewhere ``bs`` and ``weight``, which come from the BSDF. If the direction in a medium
        ``is_given``, ``sample_2`` is its point (:func:`direction_at`)."""
        return bs, weight

    def scattered(self, bs, active) -> mi.Bool:
        """The ``active`` samples ``bs`` that scatter, and do not pass an index-matched surface."""
        return active

    def depth_behind(self, bs, depth: mi.UInt32) -> mi.UInt32:
        """The depth of the vertex after one at ``depth``."""
        return depth + 1

    def leave(self, vertex: Vertex, bs, path: PathState) -> PathState:
        """The state of a path that leaves ``vertex`` with the sample ``bs``."""
        return path

    def is_within(self, depth: mi.UInt32, max_depth: int, active) -> mi.Bool:
        """The ``active`` paths that may have one more vertex, at ``depth``."""
        return active

    def kept(self, bs, before: Any, after: Any) -> Any:
        """The state of the next event decision: ``before`` at index-matched surfaces, elsewhere
        ``after``."""
        return after

    def cross(self, inside, si, d) -> Any:
        """The state behind the surface ``si``, in the direction ``d``."""
        return inside

    def visible_emission(self, emitted, path: PathState, si, scattered) -> mi.Spectrum:
        """The emission that a path gains from the light that it hits at ``si``. ``scattered`` tells
        whether the path has scattered before, not only passed through null surfaces."""
        if not self._hides:
            return emitted
        return dr.select(self.sees_light(path, si, scattered), emitted, 0)

    def sees_light(self, path: PathState, si, scattered) -> mi.Bool:
        """Whether a path sees the light at ``si`` although lights are hidden."""
        # The path does not meet hidden area lights (``behind``)
        return si.is_valid() | scattered
