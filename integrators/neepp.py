"""NEE++: next event estimation that learns which lights to choose, and what to test."""

from __future__ import annotations

import mitsuba as mi

from mitsuba_ext import registry
from mitsuba_ext.composition.next_event import METHODS, LearnedLights
from mitsuba_ext.composition.shadow_test import RejectedShadowRays
from mitsuba_ext.composition.walk_integrator import WalkIntegrator

_LEARNING = "lights that are chosen by what was learned (visibility or contribution)"
_REJECTING = "shadow rays that are rejected"

#: What parameters need to have an effect.
_CONDITIONS = {
    "grid": f"{_LEARNING} or spatially, or {_REJECTING}",
    "max_memory": f"{_LEARNING} or spatially, or {_REJECTING}",
    "pilot_spp": f"{_LEARNING}, or {_REJECTING}",
    "refine": f"{_REJECTING}, and lights not learned",
    "law": _REJECTING,
    "slope": f"{_REJECTING} by the affine law",
    "floor": f"{_REJECTING} by the affine law",
    "load_map": _LEARNING,
    "save_map": _LEARNING,
}


@registry.plugin
class NEEPlusPlus(WalkIntegrator):
    r"""
    .. _integrator-neepp:

    Next event estimation++ (:monosp:`neepp`)
    -----------------------------------------

    A path tracer that learns from its first samples which lights reach which surfaces. It chooses
    lights accordingly, also parts of large lights and directions of the sky, and can reject most of
    the shadow rays that would be blocked. Both are unbiased.

    .. pluginparameters::

     * - light_sampling
       - |string|
       - How a light is chosen at each vertex. Learned, for the voxel and the side of the surface:
         :monosp:`contribution` (by what arrived from it), :monosp:`visibility` (by how often it was
         visible, times what it would contribute unoccluded). Not learned: :monosp:`uniform` (as
         :monosp:`path` chooses), :monosp:`power`, :monosp:`spatial` (unoccluded contributions, per
         voxel, as in pbrt-v3), :monosp:`linear` (an estimate for each light at each vertex; its
         cost grows with their number). (Default: contribution)
     * - rejection
       - |bool|
       - Reject shadow rays by learned visibility. It saves time where lights are not chosen by what
         was learned; otherwise those that are hidden are hardly chosen any more, and rejection
         costs more error than it saves time. (Default: false)
     * - grid
       - |int|
       - Voxels along each axis of the region in which paths scatter (of the scene's bounding box,
         where :monosp:`light_sampling` is not learned). (Default: 16, or fewer where the pilot has
         few samples for the voxels that it sees and the lights; 16 for rejection without learned
         light sampling; 32, or what fits into the memory, for :monosp:`spatial`)
     * - max_memory
       - |float|
       - Memory for what is learned, and for the table of :monosp:`spatial`, in MiB. Where
         :monosp:`grid` needs more, a coarser grid is used, with a warning. (Default: 512)
     * - pilot_spp
       - |int|
       - Samples per pixel from which is learned, at most a quarter of all. They count towards the
         image. With 0 nothing is learned: lights are chosen as by :monosp:`path`, and every shadow
         ray is traced. A sampler that is stratified over all samples may need longer pilots.
         (Default: 16)
     * - law
       - |string|
       - With :monosp:`rejection` only, as the next two: how the probability of tracing a shadow
         ray follows from the learned visibility V:
         :monosp:`affine` for min(1, slope · V + floor), :monosp:`paper` for max(V, 1e-4), as
         printed: it traces fewer rays and is much noisier. (Default: affine)
     * - slope
       - |float|
       - Slope of the affine law; unknown to the other. (Default: 10)
     * - floor
       - |float|
       - Least probability of the affine law, 1e-6 to 1; unknown to the other. (Default: 0.1)
     * - refine
       - |int|
       - With :monosp:`rejection`, and only where light sampling is not learned: random visibility
         tests added to each entry of the map in which the pilot saw a success, for the voxels with
         a light. (Default: 16)
     * - save_map
       - |string|
       - File to which the learned map is written; its folder must be there. (Default: none)
     * - load_map
       - |string|
       - File of a map to begin with, from this view of the scene or another one; the pilot adds to
         it. A map of another scene is refused. (Default: none)
     * - max_depth
       - |int|
       - Longest path in the image, -1 for no limit. 1 shows visible emitters only, 2 adds direct
         illumination, and so on. (Default: -1)
     * - rr_depth
       - |int|
       - Path depth at which Russian roulette on the throughput begins. (Default: 5)
     * - hide_emitters
       - |bool|
       - Hide directly visible emitters. (Default: false)
     * - timeout
       - |float|
       - Seconds after which to stop, learning and compilation included; 0 or less for no limit. It
         is kept as by :monosp:`composed_path`. Pilots then get at most a quarter of the samples
         that fit. A short pass of each pilot, and one of the rest, are always taken. (Default: -1)
     * - aovs
       - |string|
       - Arbitrary output variables, in the syntax of Mitsuba's :monosp:`aov` integrator, such as
         :monosp:`depth:depth,nn:sh_normal`. (Default: none)

    **Use it when** there are many lights, when most of them are hidden from most places (rooms, a
    sky seen through windows, lamps behind walls), or when large lights are partly covered. **Not
    when** one small light lights an open scene, or when the difficulty lies elsewhere, in indirect
    or glossy light: it then costs the pilots' bookkeeping.

    A first sample per pixel, which is none of the image's, finds the region and the surfaces. Two
    pilots follow, the second of which chooses its lights by what the first has learned; all samples
    weigh the same, and none teaches a stage that it is part of, so that the image is unbiased. A
    tenth of the choices does not depend on what was learned. Where the first pilot finds that
    choosing as :monosp:`path` does is nearly as good (less than 7 % of the variance to gain),
    learning ends there, unless :monosp:`grid`, :monosp:`rejection` or a file of a map is given.
    Where light sampling is not learned, rejection knows lights in the scene's bounding box only;
    those outside of it and at infinity are then always tested.

    Lights on meshes with interpolated normals are sampled by the area of their triangles;
    :monosp:`path` and :monosp:`uniform` are biased there, by a fault in Mitsuba. Participating
    media are ignored, as by :monosp:`path`. Gradients are not supported (use :monosp:`prb`), nor
    are scalar and polarized variants. Nested in :monosp:`moment` there is no pilot.

    Sources: J. Guo, M. Eisemann, E. Eisemann, *Next Event Estimation++: Visibility Mapping for
    Efficient Light Transport Simulation*, Computer Graphics Forum 39(7), 2020, sections 3 to 4.2;
    P. Shirley in H. W. Jensen et al., *Monte Carlo Ray Tracing*, SIGGRAPH 2003 course 44, section
    3.4 (:monosp:`linear`).

    .. tabs::
        .. code-tab:: xml

            <integrator type="neepp">
                <integer name="max_depth" value="8"/>
                <string name="light_sampling" value="contribution"/>
            </integrator>

        .. code-tab:: python

            'type': 'neepp',
            'max_depth': 8,
            'light_sampling': 'contribution'
    """

    def __init__(self, props: mi.Properties) -> None:
        super().__init__(props)
        read = self.reader(props)
        method = read("light_sampling", "contribution", choices=tuple(METHODS))
        rejects = read("rejection", False)
        make_lights = METHODS[method]
        lights = make_lights(read) if make_lights else None
        learns = isinstance(lights, LearnedLights)
        rejection = RejectedShadowRays(read, has_own_map=not learns) if rejects else None
        self.fill(props, next_event=lights, shadow_test=rejection)
        read.refuse_without_effect(_CONDITIONS)
