"""Vertex connection and merging."""

from __future__ import annotations

import mitsuba as mi

from mitsuba_ext.bases.bidirectional_integrator import BidirectionalIntegrator
from mitsuba_ext.estimators.light_paths.merging.merging_parameters import MergingParameters
from mitsuba_ext.startup import registry


@registry.plugin
class VertexConnectionAndMerging(BidirectionalIntegrator):
    r"""
    .. _integrator-vcm:

    Vertex connection and merging (:monosp:`vcm`)
    ---------------------------------------------

    Combines bidirectional path tracing (:class:`bdpt`) and photon mapping: light that arrives near
    a vertex of a camera path counts at that vertex as well (merging), with MIS weights over all
    techniques.

    .. pluginparameters::

     * - merging
       - |string|
       - Where vertices are merged: with :monosp:`caustics`, only where light arrives from a mirror
         or smooth glass; with :monosp:`all`, on all rough surfaces and in all media, as in the
         sources; with :monosp:`none`, nowhere, which makes the integrator :class:`bdpt`. (Default:
         caustics)
     * - radius
       - |float|
       - Radius within which vertices are merged in a first pass of one sample per pixel, in units
         of the scene. A pass of k samples per pixel uses 1/k of the area. With 0, light paths
         traced before the render choose the radius, so that a disk contains about eight of the
         vertices of a pass in places that have any. It is then at most 8 pixel widths at the first
         sample, and this limit shrinks with the number of samples so far, in passes of any size.
         (Default: 0)
     * - radius_in_media
       - |float|
       - As ``radius``, for vertices in participating media, which are merged in a ball: a pass of k
         samples per pixel uses 1/k of the volume. 0 stands for a radius with which half of the
         balls contain about eight vertices or more, but at most two mean free paths. (Default: 0)
     * - radius_decay
       - |float|
       - α, in (0, 1]: the squared radius of pass i (in media, its cube) is the squared radius (or
         cube) of the first pass times i to the power of α − 1. With 1, it is constant. (Default:
         0.75)
     * - (Parameters of bdpt)
       - |several|
       - The parameters of :class:`bdpt`: light_paths, connections, light_image, subpath_selection,
         sample_direct, next_event, directions, roulette, shadow_test.
     * - (Common parameters)
       - |several|
       - The parameters of :class:`WalkIntegrator`: max_depth, rr_depth, hide_emitters, timeout,
         aovs, checkpoint.

    With :monosp:`light_paths=auto`, the pilot of :class:`bdpt` also decides whether to merge
    vertices.

    **Use it when** caustics are seen through water or glass, or in mirrors: no connection finds
    them. With :monosp:`merging=all`, also for skin, milk and marble. **Not when** :class:`bdpt` or
    :monosp:`path` finds all light: merging takes time and adds a little bias.

    Merging is biased with any finite number of samples: it blurs light over the radius. The bias
    falls with the squared radius, which shrinks from pass to pass, so the image converges. The bias
    is small where other techniques have large weights.

    In a render in batches (:monosp:`checkpoint`, or several workers), each batch continues with the
    radius at which the previous one ended.

    In spectral variants, sample k of each pixel has the same wavelengths, and with moving shapes
    the same time: otherwise the vertices of other paths could not be merged. Errors of colour and
    motion blur are then the same in all pixels; they fall faster than noise.

    **Participating media** are rendered as with :class:`bdpt`. Vertices in media merge where both
    lie in the same medium. Where a ball reaches out of the medium, it finds too little light.

    The parameter ``technique_images`` of :class:`bdpt` is refused with merging.

    Source: I. Georgiev, J. Křivánek, T. Davidovič, P. Slusallek, *Light Transport Simulation with
    Vertex Connection and Merging*, ACM Transactions on Graphics 31(6), 2012; I. Georgiev,
    *Implementing Vertex Connection and Merging*, technical report, 2012; C. Knaus, M. Zwicker,
    *Progressive Photon Mapping: A Probabilistic Approach*, ACM Transactions on Graphics 30(3),
    2011 (radius); J. Křivánek et al., *Unifying Points, Beams, and Paths in Volumetric Light
    Transport Simulation*, ACM Transactions on Graphics 33(4), 2014 (media; merging of points, not
    of beams).

    .. tabs::
        .. code-tab:: xml

            <integrator type="vcm">
                <integer name="max_depth" value="12"/>
            </integrator>

        .. code-tab:: python

            'type': 'vcm',
            'max_depth': 12
    """

    def __init__(self, props: mi.Properties) -> None:
        super().__init__(props)
        self.where = self.parameter(
            props, "merging", "caustics", choices=("caustics", "all", "none")
        )
        merging = MergingParameters.read(self, props)
        self.merging = None if self.where == "none" else merging
        if self.where != "none" and self.technique_images:
            raise ValueError(
                f'"{self.name}": the parameter "technique_images" cannot be combined with merging; '
                f'leave it out, or use "bdpt"'
            )

    def merges_all(self, scene):
        return self.where == "all"

    def parameters(self):
        shown = super().parameters()
        return shown if self.merging else {k: v for k, v in shown.items() if "radius" not in k}
