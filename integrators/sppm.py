"""Stochastic progressive photon mapping."""

from __future__ import annotations

import math

import mitsuba as mi

from mitsuba_ext.bases.walk_integrator import WalkIntegrator
from mitsuba_ext.estimators.light_paths.choice.light_paths import MOST_PATHS, check_shared_rays
from mitsuba_ext.estimators.light_paths.light_media import outside_of
from mitsuba_ext.estimators.light_paths.merging.merging_parameters import (
    MergingParameters,
    shared_numbers,
)
from mitsuba_ext.estimators.light_paths.path_memory import bytes_of_photons
from mitsuba_ext.estimators.light_paths.photons.photons import photon_mapper
from mitsuba_ext.rendering.device import SampleBytes
from mitsuba_ext.rendering.stages import OneStage
from mitsuba_ext.startup import registry
from mitsuba_ext.transport.decisions import CameraSamples, Decisions
from mitsuba_ext.transport.path_decisions import NoConnections


@registry.plugin
class ProgressivePhotonMapping(WalkIntegrator):
    r"""
    .. _integrator-sppm:

    Stochastic progressive photon mapping (:monosp:`sppm`)
    ------------------------------------------------------

    Traces photons from the lights in each pass. From nearby photons, it estimates the light that
    leaves the first rough surface of each camera path, and the light that participating media
    scatter on the way there. The radius shrinks from pass to pass, so the image converges.

    .. pluginparameters::

     * - radius
       - |float|
       - Radius within which photons are looked up in a first pass of one sample per pixel, in units
         of the scene. A pass of k samples per pixel uses 1/k of the area (unless all samples of a
         pixel see the same point, as with a :monosp:`radiancemeter`). With 0, light paths traced
         before the render choose the radius, so that a disk contains about eight of the vertices of
         a pass in places that have any. It is then at most 8 pixel widths at the first sample, and
         this limit shrinks with the number of samples so far, in passes of any size. (Default: 0)
     * - radius_in_media
       - |float|
       - As ``radius``, for photons in participating media, which are looked up in a ball: a pass of
         k samples per pixel uses 1/k of the volume. 0 stands for a radius with which half of the
         balls contain about eight photons or more. (Default: 0)
     * - radius_decay
       - |float|
       - α, in (0, 1]: the squared radius of pass i (in media, its cube) is the squared radius (or
         cube) of the first pass times i to the power of α − 1. With 1, it is constant. (Default:
         0.75)
     * - light_paths
       - |float|
       - Number of light paths per camera path. More light paths make the radius of a pass smaller.
         (Default: 1)
     * - (Common parameters)
       - |several|
       - The parameters of :class:`WalkIntegrator`: max_depth, rr_depth, hide_emitters, timeout,
         aovs, checkpoint.

    **Use it when** caustics of lamps of any size are seen through water or glass, or in mirrors; or
    in fog, for a lamp that shines through glass, or beams of light. **Not when** the scene is large
    and well lit: each surface needs photons of its own. The integrator :class:`vcm` combines this
    technique with all others.

    The image is biased with any number of samples: light is blurred over the radius, and edges and
    creases narrower than the radius are too dark. The bias falls with the squared radius. Vertices
    merge only on surfaces that face in about the same direction, so light does not leak through
    thin walls.

    In a render in batches (:monosp:`checkpoint`, or several workers), each batch continues with the
    radius at which the previous one ended.

    In spectral variants, sample k of each pixel has the same wavelengths, and with moving shapes
    the same time: otherwise photons could not be merged. Errors of colour and motion blur are then
    the same in all pixels; they fall faster than noise.

    Homogeneous and grid media are rendered. Light is blurred over the ball: the outlines of a fog
    are too dark, and light leaks past the edges of walls that are thinner than the radius. A light
    is taken to lie in the medium on its side of the closest boundary, in the direction of each
    photon; outside all boundaries, in the medium behind the last boundary that a ray from the
    sensor crosses. Lights at infinity are refused if that medium is not a vacuum. In camera rays
    through homogeneous media, ``sample_emitters`` is ignored.

    Curves whose BSDF transmits light, such as :monosp:`hair`, are refused, because photons do not
    pass through them (use :class:`vcm`). Gradients are not supported (use :class:`composed_prb`),
    and neither is nesting in :monosp:`moment` and :monosp:`aov`.

    Source: T. Hachisuka, H. W. Jensen, *Stochastic Progressive Photon Mapping*, ACM Transactions on
    Graphics 28(5), 2009; C. Knaus, M. Zwicker, *Progressive Photon Mapping: A Probabilistic
    Approach*, ACM Transactions on Graphics 30(3), 2011; D. Cline, PhD thesis, 2007, section 7.7;
    H. W. Jensen, P. H. Christensen, *Efficient Simulation of Light Transport in Scenes with
    Participating Media Using Photon Maps*, SIGGRAPH 1998.

    .. tabs::
        .. code-tab:: xml

            <integrator type="sppm">
                <integer name="max_depth" value="12"/>
            </integrator>

        .. code-tab:: python

            'type': 'sppm',
            'max_depth': 12
    """

    has_light_paths = light_paths_see_media = True

    def __init__(self, props: mi.Properties) -> None:
        super().__init__(props)
        self.merging = MergingParameters.read(self, props)
        self.light_paths = self.parameter(
            props, "light_paths", 1.0, minimum=1 / MOST_PATHS, maximum=MOST_PATHS
        )
        self.fill(props)

    @property
    def needs_equal_samples(self) -> str:
        return "the radius of its photons suits the number of light paths of a pass"

    @property
    def sample_cost(self) -> int:
        return max(3, math.ceil(self.light_paths))

    @property
    def sample_bytes(self) -> SampleBytes:
        return bytes_of_photons(self.light_paths, self.max_depth)

    def schedule(self, request, samples, learning) -> OneStage:
        scene = request.scene
        if not scene.emitters() or self.max_depth < 2:
            alone = Decisions(next_event=NoConnections(), query=self.query(scene))
            return OneStage(self.walk(alone))
        check_shared_rays(self.name, scene, self.light_paths)
        outside_of(self.name, self.query(scene), scene, request.sensor)
        mapper = photon_mapper(self, request, self.merging, self.light_paths)
        return OneStage(mapper, CameraSamples(**shared_numbers(scene, request.seed)))
