"""NEE++: next event estimation that learns which lights to choose and which shadow rays to
trace."""

from __future__ import annotations

import mitsuba as mi

from mitsuba_ext.bases.slots import LIGHT_CHOICES, read_slot
from mitsuba_ext.bases.walk_integrator import WalkIntegrator
from mitsuba_ext.startup import registry
from mitsuba_ext.techniques.shadow_rejection.parameters import RejectedShadowRays

_LEARNING = "lights that are chosen by what was learned (visibility or contribution)"
_REJECTING = "shadow rays that are rejected"

#: What each parameter needs to have an effect, for error messages.
_CONDITIONS = {
    "grid": f"{_LEARNING} or spatially, or {_REJECTING}",
    "max_memory": f"{_LEARNING} or spatially, or {_REJECTING}",
    "pilot_spp": f"{_LEARNING}, or {_REJECTING}",
    "refine": f"{_REJECTING}, and lights not learned",
    "law": _REJECTING,
    "slope": f"{_REJECTING} by the affine law",
    "floor": f"{_REJECTING} by the affine law",
}


@registry.plugin
class NEEPlusPlus(WalkIntegrator):
    r"""
    .. _integrator-neepp:

    Next event estimation++ (:monosp:`neepp`)
    -----------------------------------------

    A path tracer that learns from its first samples which lights reach which surfaces. It samples
    lights accordingly, including parts of large lights and directions of the sky, and can reject
    most of the shadow rays that would be blocked. Both techniques are unbiased. The integrator is
    :monosp:`composed_path` with :monosp:`learned_lights`, and on request with
    :monosp:`visibility_roulette`; the pages of these plugins have the details.

    .. pluginparameters::

     * - light_sampling
       - |string|
       - How a light is chosen at each vertex, as with :monosp:`next_event` of
         :monosp:`composed_path`. Learned: :monosp:`contribution`, :monosp:`visibility`. Not
         learned: :monosp:`uniform`, :monosp:`power`, :monosp:`spatial`, :monosp:`tree`,
         :monosp:`linear`. (Default: contribution)
     * - rejection
       - |bool|
       - Whether to reject shadow rays by learned visibility. This saves time if
         :monosp:`light_sampling` is not learned. If it is learned, hidden lights are hardly ever
         chosen, and rejection increases the error by more than the time it saves. (Default: false)
     * - grid
       - |int|
       - Number of voxels along each axis of the region in which paths scatter (of the scene's
         bounding box, if :monosp:`light_sampling` is not learned). (Default: as for
         :monosp:`learned_lights`, :monosp:`spatial_lights` or :monosp:`visibility_roulette`)
     * - max_memory
       - |float|
       - Memory for what is learned, and for the table of :monosp:`spatial`, in MiB. (Default: 512)
     * - pilot_spp
       - |int|
       - Number of pilot samples per pixel, from which the integrator learns; at most an eighth of
         all samples (a quarter in short renders). They count towards the image. With 0, it learns
         nothing: lights are chosen by a light tree, and every shadow ray is traced. With a
         stratified sampler, pilots consist of whole passes, and can be longer. (Default: 16)
     * - save_learned, load_learned
       - |string|
       - Names of files. The render saves all that it has learned to :monosp:`save_learned`. With
         :monosp:`load_learned`, it takes no pilot samples, but uses what a render of the same
         scene, with the same parameters and film size, has saved, even from another camera.
         (Default: none)
     * - keep_learned
       - |bool|
       - Whether to keep what is learned for later renders of this process (frames, notebooks). A
         later render of the same scene, with the same parameters and film size, then takes no pilot
         samples, even from another camera. It learns again if it would take more pilot samples than
         the earlier render. An image then depends on the renders before it. (Default: false)
     * - law, slope, floor
       - |several|
       - With :monosp:`rejection`: the law of :monosp:`visibility_roulette`. (Default: affine, 10,
         0.1)
     * - refine
       - |int|
       - With :monosp:`rejection`, and only if light sampling is not learned: the number of random
         visibility tests of :monosp:`visibility_roulette`. (Default: 16)
     * - clamp_direct, clamp_indirect
       - |float|
       - **Biased**: the largest light of a sample, see :class:`composed_path`. 0 clamps nothing.
         (Default: 0)
     * - caustics
       - |string|
       - Whether paths also connect to lights through smooth glass and mirrors
         (:monosp:`manifold`, or :monosp:`bounded_manifold`, which is **biased**), as in
         :class:`composed_path`. (Default: scattered)
     * - (Common parameters)
       - |several|
       - The parameters of :class:`WalkIntegrator`: max_depth, rr_depth, hide_emitters, timeout,
         aovs, checkpoint.

    **Use it when** there are many lights, when most lights are hidden from most places (rooms, a
    sky seen through windows, lamps behind walls), or when large lights are partly covered. **Not
    when** one small light illuminates an open scene, or when most noise comes from indirect or
    glossy light: learning then costs time and gains nothing.

    A first sample per pixel, which is not added to the film, finds the surfaces and the region in
    which paths scatter. The first pilot chooses among several lights by a light tree, which is kept
    if a learned table would not be much better. Otherwise each further pilot chooses its lights by
    what the earlier pilots have learned. If these show that the gain is small, learning ends early,
    unless :monosp:`grid` or :monosp:`rejection` is given.

    Participating media are rendered as in :monosp:`volpath`; lights are learned for points in media
    as they are for surfaces (:monosp:`light_sampling=linear` refuses media). Gradients are not
    supported (use :class:`composed_prb`); neither are scalar and polarized variants. Nested in
    :monosp:`moment`, it takes no pilot samples.

    Source: J. Guo, M. Eisemann, E. Eisemann, *Next Event Estimation++: Visibility Mapping for
    Efficient Light Transport Simulation*, Computer Graphics Forum 39(7), 2020, sections 3 to 4.2.

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

    can_clamp = True

    def __init__(self, props: mi.Properties) -> None:
        super().__init__(props)
        read = self.reader(props)
        method = read("light_sampling", "contribution", choices=tuple(LIGHT_CHOICES))
        rejects = read("rejection", False)
        make_lights = LIGHT_CHOICES[method]
        lights = make_lights(read) if make_lights else None
        learns = lights is not None and lights.tells_visibility
        rejection = RejectedShadowRays(read, has_own_map=not learns) if rejects else None
        caustics = read_slot(self.name, props, "caustics")
        self.fill(props, next_event=lights, shadow_test=rejection, caustics=caustics)
        read.refuse_without_effect(_CONDITIONS)
