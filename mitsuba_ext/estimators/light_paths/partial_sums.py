"""Partial sums that a subpath carries along. The MIS weights of complete paths, over all
bidirectional techniques, are computed from them.

Source: I. Georgiev, *Implementing Vertex Connection and Merging*, technical report, 2012: the
quantities dVCM and dVC, without merging. All ratios of densities are raised to the exponent of the
MIS heuristic.
"""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi

from ...transport.path_decisions import SubpathSelection
from .both_ends import from_both_ends
from .scattering import SurfaceTerms, is_in_medium


@dataclass
class Sums:
    """The partial sums of a subpath at its last vertex (Eqs. 31 to 36 of the report).

    Attributes:
        dVCM: 1 / density of the last vertex, times the number of samples of the technique that
            connects the last two vertices. At the first vertex, the second factor is instead the
            ratio of the densities with which next event estimation and emission sample the point on
            the light.
        dVC: The sum over the techniques that connect earlier vertices of the subpath.
        by_camera: The two terms of dVC in which a camera path finds the whole path (s = 0 and 1),
            not raised to the exponent, from the second vertex on. ``None`` for camera paths, and if
            :class:`PartialSums` does not compute it.
        region: The region of the last vertex; ``None`` if the light path vertices for connections
            are not chosen by regions.
        count: The factor of ``dVCM`` where the technique that connects the last two vertices is
            such a connection; ``None`` as for ``region``.
        is_caustic: Whether the direction that led to the last vertex was sampled from a delta lobe;
            ``None`` for camera paths, and if vertices are not merged.
        by_kind: The parts of dVC that belong to connections (s, t ≥ 2) and to the light image
            (t = 1; only for camera paths); ``None`` if :class:`PartialSums` does not compute it.
        merging: The density of merging at the last vertex (:meth:`PartialSums.merging_at`);
            ``None`` if it is the same at all vertices.
    """

    dVCM: mi.Float
    dVC: mi.Float
    by_camera: mi.Vector2f | None = None
    region: mi.UInt32 | None = None
    count: mi.Float | None = None
    is_caustic: mi.Bool | None = None
    by_kind: mi.Vector2f | None = None
    merging: mi.Float | None = None

    @property
    def last(self) -> mi.Float:
        """``dVCM``, times ``count`` if vertices are chosen by regions."""
        return self.dVCM if self.count is None else self.dVCM * self.count


@dataclass
class CompetingDensities:
    """The densities with which the other techniques find a path that one technique has found. They
    are divided by that technique's density times the number of its samples.

    Attributes:
        by_camera: The densities of camera paths alone (s = 0 and 1).
        by_kind: The sum over connections (s, t ≥ 2), and the density of the light image (t = 1),
            raised to the exponent of the MIS heuristic.
    """

    by_camera: mi.Vector2f
    by_kind: mi.Vector2f


class PartialSums:
    """Computes the sums along light paths and camera paths.

    Parameters:
        connections: The average fraction of the vertices of a light path to which a vertex of a
            camera path is connected (s, t ≥ 2). Camera paths are connected to the light (s = 1) and
            hit it (s = 0) once.
        exponent: 1 for the balance heuristic, 2 for the power heuristic.
        splits: Whether ``by_camera`` and ``by_kind`` of :class:`Sums` are computed.
        selection: Chooses the vertices of light paths by regions; its ``expected`` for a pair of
            regions multiplies ``connections``. ``None`` if the choice is uniform.
        merging: The density of merging at a vertex, relative to the product of the densities with
            which both subpaths sample it: π r² · number of light paths, or a multiple of it.
            ``None`` if vertices are not merged.
        merging_in_media: The same for vertices in participating media, divided by the extinction:
            4/3 π r³ · number of light paths, or the same multiple; ``None`` if vertices are not
            merged, or none lie in media.
        merges_all: Whether vertices are merged wherever their BSDF is smooth. If not, they are
            merged only where light arrives from a delta lobe.
        light_paths: Number of light paths for each camera path: the number of samples of the
            technique that connects light paths to the sensor (t = 1).
        has_clear_curves: Whether light passes through a curve (``scene/bsdfs.py``).
        terms: The terms of vertices.
    """

    def __init__(
        self,
        connections: mi.Float | float = 1.0,
        exponent: int = 2,
        splits: bool = False,
        selection: SubpathSelection | None = None,
        merging: mi.Float | None = None,
        merges_all: bool = False,
        light_paths: mi.Float | float = 1.0,
        has_clear_curves: bool = False,
        terms: SurfaceTerms = SurfaceTerms(),  # noqa: B008  (never modified)
        merging_in_media: mi.Float | None = None,
    ) -> None:
        self.terms = terms
        self.exponent, self.splits, self.selection = exponent, splits, selection
        #: ``connections``, raised to the exponent.
        self.count = self.ratio(mi.Float(connections))
        #: ``light_paths``, raised to the exponent.
        self.image_count = self.ratio(mi.Float(light_paths))
        #: ``merging``, raised to the exponent.
        self.merging = None if merging is None else self.ratio(merging)
        #: ``merging_in_media``, raised to the exponent.
        self.merging_in_media = None
        if merging_in_media is not None:
            self.merging_in_media = self.ratio(merging_in_media)
        self.merges_all = merges_all
        self._has_clear_curves = has_clear_curves

    def cosine(self, si: mi.SurfaceInteraction3f, d: mi.Vector3f) -> mi.Float:
        """The geometric cosine of a local direction; 0 for directions into a curve, from which no
        light path comes and to which none goes."""
        return dr.select(self.is_open(si, d), self.terms.cosine(si, d), 0)

    def is_open(self, si: mi.SurfaceInteraction3f, d: mi.Vector3f) -> mi.Bool:
        """Whether a local direction does not lead into a curve. The inside of curves is left to
        camera paths."""
        if not self._has_clear_curves:
            return mi.Bool(True)
        kind = si.shape.shape_type()
        curves = mi.ShapeType.BSplineCurve, mi.ShapeType.LinearCurve
        is_curve = (kind == int(curves[0])) | (kind == int(curves[1]))
        return ~is_curve | (dr.dot(si.n, si.to_world(d)) > 0)

    def ratio(self, x: mi.Float) -> mi.Float:
        """A ratio of densities, raised to the exponent."""
        return dr.square(x) if self.exponent == 2 else x

    def root(self, ratio: mi.Float) -> mi.Float:
        """The inverse of :meth:`ratio`."""
        return dr.sqrt(ratio) if self.exponent == 2 else ratio

    def begin(self, dVCM: mi.Float, dVC: mi.Float) -> Sums:
        """The sums where a subpath begins."""
        sums, lanes = Sums(dVCM, dVC), dr.width(dVCM)
        if self.splits:
            sums.by_kind = dr.zeros(mi.Vector2f, lanes)
        if self.selection is not None:
            sums.region, sums.count = dr.zeros(mi.UInt32, lanes), dr.full(mi.Float, 1, lanes)
        return sums

    def others(self, density: mi.Float, sums: Sums, reverse_pdf: mi.Float) -> mi.Float:
        """For a technique that connects a subpath's last vertex to something: the sum, over all
        techniques that sample this vertex from the other side, of their density divided by the
        density of the technique.

        Parameters:
            density: Density with which the other side samples the vertex, divided by the density
                of the technique (per area, where the technique itself has density 1).
            reverse_pdf: Density, per solid angle, of continuing from there to the previous vertex
                of the subpath.
        """
        others = sums.last + self.ratio(reverse_pdf) * sums.dVC
        if self.merging is not None and self.merges_all:
            others += self._merging(sums)
        elif self.merging is not None and sums.is_caustic is not None:
            others += dr.select(sums.is_caustic, self._merging(sums), 0)
        return self.ratio(density) * others

    def merging_at(self, si: mi.SurfaceInteraction3f, medium: mi.MediumPtr) -> mi.Float | None:
        """The density of merging at a vertex, on a surface or in ``medium``, raised to the
        exponent; ``None`` if it is the same at all vertices. In media, it contains the extinction:
        merging is the only technique that samples the vertex twice."""
        if self.merging_in_media is None:
            return None
        extinction = self.ratio(self.terms.extinction(si, medium))
        in_medium = self.merging_in_media * extinction
        return dr.select(is_in_medium(si), in_medium, self.merging)

    def _merging(self, sums: Sums) -> mi.Float:
        """The density of merging at the last vertex of a subpath, raised to the exponent."""
        return self.merging if sums.merging is None else sums.merging

    def merging_weight(
        self, light: Sums, pdf: mi.Float, camera: Sums, reverse_pdf: mi.Float
    ) -> mi.Float:
        """The MIS weight of merging the last vertices of two subpaths. The sum over the other
        techniques that merge (dVM in the report) is dVC / ``merging``.

        Parameters:
            pdf: Density, per solid angle, with which the camera path goes on to the vertex of the
                light path before the last one.
            reverse_pdf: Density with which the light path goes on to the vertex of the camera path
                before the last one.
        """
        others = light.last + self.ratio(pdf) * light.dVC
        others += camera.last + self.ratio(reverse_pdf) * camera.dVC
        return weight(others / self._merging(camera))

    def competing_with_merging(
        self,
        light: Sums,
        pdf: mi.Float,
        camera: Sums,
        reverse_pdf: mi.Float,
        is_first: tuple[mi.Bool, mi.Bool],
    ) -> CompetingDensities:
        """The densities that compete with merging. The parameters are the same as for
        :meth:`merging_weight`; ``is_first`` tells whether the vertex of the light path, and of the
        camera path, is the first one of its path."""
        inverse, one = dr.rcp(self._merging(camera)), mi.Float(1)
        kinds = self.by_kind(one, light, pdf, is_first[0], by_light=True)
        kinds += self.by_kind(one, camera, reverse_pdf, is_first[1], by_light=False)
        return CompetingDensities(
            self.by_camera(self.root(inverse), light, pdf, is_first[0]), kinds * inverse
        )

    def merging_before(
        self,
        sums: Sums,
        squared_distance: mi.Float,
        cosine: mi.Float,
        merging: mi.Float | None = None,
    ) -> mi.Float | float:
        """For a camera path that leaves a vertex by a delta lobe: the term of dVC at this vertex
        for merging at the previous vertex, where light arrives from that lobe.

        Parameters:
            sums: The sums at the vertex with the delta lobe.
            squared_distance, cosine: The squared length of the segment to the previous vertex (see
                :meth:`arrive`), and the cosine there between the segment and the geometric normal.
            merging: The density of merging there (:meth:`merging_at`).
        """
        if self.merging is None or self.merges_all:
            return 0.0
        # dVCM is 0 if the path left the previous vertex by a delta lobe too
        ratio = self.ratio(cosine / squared_distance)
        merging = self.merging if merging is None else merging
        return dr.select(squared_distance > 0, sums.dVCM / self.count * ratio * merging, 0)

    def arrive(
        self,
        sums: Sums,
        si: mi.SurfaceInteraction3f,
        squared_distance: mi.Float,
        is_first: mi.Bool,
        by_light: bool,
    ) -> Sums:
        """The sums at the next vertex, ``si``, at this distance: densities per solid angle become
        densities per area.

        Parameters:
            squared_distance: In participating media, divided by the known transmittance, since the
                segment is passed with this probability. (It is no part of dVC, where the same
                factor occurs in the densities from both sides.)
            is_first: Whether ``si`` is the first vertex of the subpath.
            by_light: Whether the subpath is a light path.
        """
        inverse = dr.rcp(dr.maximum(self.terms.cosine(si, si.wi), 1e-12))
        region, count = None, None
        if self.selection is not None:
            region = self.selection.region(from_both_ends(si), si.is_valid())
            ends = (region, sums.region) if by_light else (sums.region, region)
            expected = self.selection.expected(*ends, si.is_valid() & ~is_first)
            # The first vertex is connected to the light or the sensor, which has no region
            count = dr.select(is_first, 1, self.ratio(expected))
        return Sums(
            sums.dVCM * self.ratio(squared_distance * inverse),
            sums.dVC * self.ratio(inverse),
            None if sums.by_camera is None else sums.by_camera * inverse,
            region,
            count,
            by_kind=sums.by_kind * self.ratio(inverse) if self.splits else None,
        )

    def leave(
        self,
        sums: Sums,
        cosine: mi.Float,
        pdf: mi.Float,
        reverse_pdf: mi.Float,
        is_delta: mi.Bool,
        is_first: mi.Bool | bool,
        by_light: bool,
    ) -> Sums:
        """The sums behind a vertex, after a direction was sampled there.

        Parameters:
            cosine: The cosine between the direction and the geometric normal, not negative; behind
                a delta lobe, :func:`cosine_of_delta`.
            pdf, reverse_pdf: Density of the direction, and of the reverse direction through the
                vertex, per solid angle.
            is_delta: Whether the direction was sampled from a delta lobe. No technique then
                connects here.
            is_first: Whether this is the first vertex of the subpath.
            by_light: Whether the subpath is a light path.
        """
        leaves = cosine * dr.select(pdf > 0, dr.rcp(pdf), 0)
        smooth = self.others(leaves, sums, reverse_pdf)
        # The technique that connects the segment behind this vertex has s, t ≥ 2
        dVCM = self.count * self.ratio(dr.select(pdf > 0, dr.rcp(pdf), 0))
        return Sums(
            dr.select(is_delta, 0, dVCM),
            dr.select(is_delta, sums.dVC * self.ratio(cosine), smooth),
            self._leave_by_camera(sums, cosine, leaves, reverse_pdf, is_delta, is_first),
            sums.region,
            sums.count,
            by_kind=self._leave_by_kind(
                sums, cosine, leaves, reverse_pdf, is_delta, is_first, by_light
            ),
        )

    def by_kind(
        self,
        density: mi.Float,
        sums: Sums,
        reverse_pdf: mi.Float,
        is_first: mi.Bool | bool,
        by_light: bool,
    ) -> mi.Vector2f | None:
        """The parts of :meth:`others` that belong to connections and to the light image; ``None``
        if ``splits`` is not set. See :meth:`others` and :meth:`arrive` for the parameters."""
        if not self.splits:
            return None
        # What connects to the first vertex: the sensor for a camera path, a light for a light path
        last = dr.select(is_first, mi.Vector2f(0, 0 if by_light else 1), mi.Vector2f(1, 0))
        return self.ratio(density) * (
            last * sums.last + self.ratio(reverse_pdf) * sums.by_kind
        )

    def _leave_by_kind(self, sums, cosine, leaves, reverse_pdf, is_delta, is_first, by_light):
        smooth = self.by_kind(leaves, sums, reverse_pdf, is_first, by_light)
        if smooth is None:
            return None
        return dr.select(is_delta, sums.by_kind * self.ratio(cosine), smooth)

    def by_camera(
        self, density: mi.Float, sums: Sums, reverse_pdf: mi.Float, is_first: mi.Bool | bool
    ) -> mi.Vector2f | None:
        """The densities with which a camera path alone finds the whole path (s = 0 and 1), each
        divided by the density of connecting to the last vertex of the light path; ``None`` if
        ``splits`` is not set. The ratios are not raised to the exponent. See :meth:`others` for the
        parameters."""
        if sums.by_camera is None:
            return None
        first = mi.Vector2f(reverse_pdf * self.root(sums.dVC), self.root(sums.dVCM))
        return density * dr.select(is_first, first, reverse_pdf * sums.by_camera)

    def _leave_by_camera(self, sums, cosine, leaves, reverse_pdf, is_delta, is_first):
        smooth = self.by_camera(leaves, sums, reverse_pdf, is_first)
        if smooth is None:
            return None
        hit = mi.Vector2f(self.root(sums.dVC), 0)
        return dr.select(
            is_delta, dr.select(is_first, hit, sums.by_camera) * cosine, smooth
        )


def weight(others: mi.Float) -> mi.Float:
    """The MIS weight of a technique, from the sum of the other techniques' density ratios to it."""
    return dr.select(dr.isfinite(others), dr.rcp(1 + others), 0)
