"""Stochastic progressive photon mapping."""

from __future__ import annotations

import math
from typing import Any

import mitsuba as mi

from mitsuba_ext.bases.walk_integrator import WalkIntegrator
from mitsuba_ext.estimators.light_paths.choice.light_paths import MOST_PATHS, check_shared_rays
from mitsuba_ext.estimators.light_paths.merging.merging_parameters import (
    MergingParameters,
    share_rays,
)
from mitsuba_ext.estimators.light_paths.photons.photon_mapper import most_lanes
from mitsuba_ext.estimators.light_paths.photons.photons import photon_mapper
from mitsuba_ext.rendering.camera_samples import CameraSamples
from mitsuba_ext.rendering.stages import OneStage
from mitsuba_ext.startup import registry
from mitsuba_ext.transport.path_decisions import NoConnections


@registry.plugin
class ProgressivePhotonMapping(WalkIntegrator):
    r"""
    .. _integrator-sppm:

    Stochastic progressive photon mapping (:monosp:`sppm`)
    ------------------------------------------------------

    Traces photons from the lights in each pass. It estimates the light that leaves the first rough
    surface of each camera path from the photons around it, and so the light that participating
    media scatter on the way there. The radius shrinks from pass to pass, so that the image
    converges.

    .. pluginparameters::

     * - radius
       - |float|
       - Radius in which photons are looked for in a first pass of one sample per pixel, in
         units of the scene. A pass of k samples per pixel has 1/k of the area (except where all
         samples of a pixel see one point, as with a :monosp:`radiancemeter`). 0 stands for one in
         which a disk holds about eight of the vertices of a pass, where there are any (light paths
         that are traced before the render measure it); but for at most 8 widths of a pixel at the
         first sample, which shrink with the samples so far, in passes of any size. (Default: 0)
     * - radius_in_media
       - |float|
       - As ``radius``, for photons in participating media, which are looked for in a ball: a pass
         of k samples per pixel has 1/k of the volume. 0 stands for one in which half of the balls
         hold about eight photons or more. (Default: 0)
     * - radius_decay
       - |float|
       - α, in (0, 1]: the squared radius of pass i (in media, its cube) is that of the first times
         i to the power of α − 1. With 1 it stays. (Default: 0.75)
     * - light_paths
       - |float|
       - Number of light paths for each camera path. More of them make the radius of a pass smaller.
         (Default: 1)
     * - (Common parameters)
       - |several|
       - The parameters of :class:`WalkIntegrator`: max_depth, rr_depth, hide_emitters, timeout,
         aovs, checkpoint.

    **Use it when** caustics are seen through water or glass, or in mirrors, of lamps however small;
    or in fog: a lamp that shines through glass into fog, beams of light.
    **Not when** the scene is large and well lit: each surface needs photons of its own. The
    integrator :class:`vcm` has all other techniques beside this one.

    The image is biased with any number of samples: light is blurred over the radius, dark at edges
    and in creases that are narrower than that. The bias falls with the squared radius. Vertices
    merge only on surfaces that face about the same way, so that light does not leak through thin
    walls.

    In a render in batches (:monosp:`checkpoint`, or several workers), the radius of a batch goes on
    where that of the one before ended.

    In spectral variants, sample k of each pixel has the same wavelengths, and with moving shapes
    the same time: photons of others cannot be merged. Errors of colour and of motion blur are then
    alike in all pixels; they fall faster than noise.

    Participating media are rendered, homogeneous and grid media. Light is blurred over the ball:
    dark at the surface of a fog, and bright behind a wall that is thinner than the radius. The
    medium in which a light lies is that on its side of the closest boundary, in the direction of
    each photon; outside of all boundaries, that behind the last one that a ray from the sensor
    crosses. In camera rays through homogeneous media, ``sample_emitters`` is ignored.

    Curves whose BSDF transmits light, such as :monosp:`hair`, are refused: photons do not pass
    through them (use :class:`vcm`). Gradients are not supported (use :class:`composed_prb`), nor
    nesting in :monosp:`moment` and :monosp:`aov`.

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
        self.radius_in_media = self.parameter(props, "radius_in_media", 0.0, minimum=0.0)
        self.light_paths = self.parameter(
            props, "light_paths", 1.0, minimum=1 / MOST_PATHS, maximum=MOST_PATHS
        )
        self.fill(props)

    def parameters(self) -> dict[str, Any]:
        own = {
            "radius_in_media": self.radius_in_media or "automatic",
            "light_paths": self.light_paths,
        }
        return {**self.merging.parameters(), **own, **super().parameters()}

    @property
    def needs_equal_samples(self) -> str:
        return "the radius of its photons suits the number of light paths of a pass"

    @property
    def sample_cost(self) -> int:
        return max(3, math.ceil(self.light_paths))

    @property
    def most_lanes(self) -> int:
        return most_lanes(self.light_paths)

    def schedule(self, scene, sensor, samples, seed) -> OneStage:
        if not scene.emitters() or self.max_depth < 2:
            return OneStage(self.walk(next_event=NoConnections(), query=self.query(scene)))
        check_shared_rays(self.name, scene, self.light_paths)
        mapper = photon_mapper(
            self, scene, sensor, self.merging, self.radius_in_media, self.light_paths
        )
        camera = CameraSamples()
        share_rays(camera, scene, seed)
        return OneStage(mapper, camera)
