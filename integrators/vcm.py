"""Vertex connection and merging."""

from __future__ import annotations

from typing import Any

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

    Bidirectional path tracing (:class:`bdpt`) and photon mapping in one: light that reaches the
    surroundings of a vertex of a camera path counts there as well (merging), with MIS weights over
    all techniques.

    .. pluginparameters::

     * - merging
       - |string|
       - Where vertices are merged: :monosp:`caustics`, where light arrives from a mirror or smooth
         glass; :monosp:`all`, on all rough surfaces, as in the source; :monosp:`none`, which makes
         the integrator :class:`bdpt`. (Default: caustics)
     * - radius
       - |float|
       - Radius in which vertices are merged in a first pass of one sample per pixel, in
         units of the scene. A pass of k samples per pixel has 1/k of the area. 0 stands for one in
         which a disk holds about eight of the vertices of a pass, where there are any (light paths
         that are traced before the render measure it); but for at most 8 widths of a pixel at the
         first sample, which shrink with the samples so far, in passes of any size. (Default: 0)
     * - radius_decay
       - |float|
       - α, in (0, 1]: the squared radius of pass i is that of the first times i to the power of
         α − 1. With 1 it stays. (Default: 0.75)
     * - (Parameters of bdpt)
       - |several|
       - The parameters of :class:`bdpt`: light_paths, connections, light_image, subpath_selection,
         sample_direct, next_event, directions, roulette, shadow_test.
     * - (Common parameters)
       - |several|
       - The parameters of :class:`WalkIntegrator`: max_depth, rr_depth, hide_emitters, timeout,
         aovs, checkpoint.

    With :monosp:`light_paths=auto`, the pilot of :class:`bdpt` also decides whether vertices are
    merged.

    **Use it when** caustics are seen through water or glass, or in mirrors: no connection finds
    these. **Not when** :class:`bdpt` or :monosp:`path` finds all light: merging takes time, and
    adds a little bias.

    Merging is biased with any number of samples: light is blurred over the radius. The bias falls
    with the squared radius, which shrinks from pass to pass, so that the image converges. Where
    other techniques have large weights, there is little of it.

    In a render in batches (:monosp:`checkpoint`, or several workers), the radius of a batch goes on
    where that of the one before ended.

    In spectral variants, sample k of each pixel has the same wavelengths, and with moving shapes
    the same time: vertices of other paths cannot be merged. Errors of colour and of motion blur are
    then alike in all pixels; they fall faster than noise.

    Participating media are refused: the light paths do not scatter in them (use :monosp:`sppm`,
    :monosp:`composed_path` or :monosp:`volpath`). So is ``technique_images`` of :class:`bdpt` with
    merging.

    Source: I. Georgiev, J. Křivánek, T. Davidovič, P. Slusallek, *Light Transport Simulation with
    Vertex Connection and Merging*, ACM Transactions on Graphics 31(6), 2012; I. Georgiev,
    *Implementing Vertex Connection and Merging*, technical report, 2012; C. Knaus, M. Zwicker,
    *Progressive Photon Mapping: A Probabilistic Approach*, ACM Transactions on Graphics 30(3),
    2011 (radius).

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

    @property
    def merges_all(self) -> bool:
        return self.where == "all"

    def parameters(self) -> dict[str, Any]:
        radius = self.merging.parameters() if self.merging else {}
        return {"merging": self.where, **radius, **super().parameters()}
