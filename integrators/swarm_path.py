"""Sample swarming."""

from __future__ import annotations

import mitsuba as mi

from mitsuba_ext.bases.slots import read_slot
from mitsuba_ext.bases.walk_integrator import WalkIntegrator
from mitsuba_ext.startup import registry
from mitsuba_ext.techniques.swarming.parameters import TECHNIQUES

#: For each parameter, the slot that its maps fill.
_SLOTS = {
    "time_map": "time", "lens_map": "aperture", "wavelength_map": "wavelength",
    "distance_map": "distance", "light_map": "light_numbers", "lobe_map": "directions",
    "direction_map": "scattering",
}  # fmt: skip

#: The maps of each slot.
_MAPS = {slot: maps for maps in TECHNIQUES for slot in maps.slots}

#: Maps that are off by default, because they rarely gain more than they cost.
_OFF_BY_DEFAULT = ("direction_map",)


@registry.plugin
class SwarmPath(WalkIntegrator):
    r"""
    .. _integrator-swarm_path:

    Sample swarming (:monosp:`swarm_path`)
    --------------------------------------

    A path tracer in which neighbouring pixels tell each other which random numbers found light. For
    each kind of sampling decision, every tile of the film has a map: a table of probabilities over
    the random numbers of this decision, learned from the samples of the image itself. It is
    unbiased, and uses only maps that reduce the variance by enough to be worth their time. It is
    :monosp:`composed_path` with the word :monosp:`swarm` in several slots.

    .. pluginparameters::

     * - time_map
       - |bool|
       - Whether to learn at which times of the shutter interval paths find light. (Default: true)
     * - lens_map
       - |bool|
       - Whether to learn through which parts of the aperture paths find light. (Default: true)
     * - wavelength_map
       - |bool|
       - Whether to learn at which wavelengths paths find light. This has an effect in spectral
         variants only. (Default: true)
     * - distance_map
       - |bool|
       - Whether to learn at which distances in a homogeneous medium camera rays find light.
         (Default: true)
     * - light_map
       - |bool|
       - Whether to learn which light, and which point on it, to sample for the first connection of
         a path. (Default: true)
     * - lobe_map
       - |bool|
       - Whether to learn the choice between reflection and transmission at the first eight bounces.
         A fifth of the paths draw uniform numbers at all bounces, and paths are weighted by the
         balance heuristic, so no path has more than five times its weight without maps. (Default:
         true)
     * - direction_map
       - |bool|
       - Whether to learn from which directions light arrives at the first vertex that is not a
         mirror. Half of its directions are chosen by the map. Off by default: it pays when light
         comes from a small bright patch (scenes/bounce_card.xml), and seldom otherwise. (Default:
         false)
     * - always_use
       - |bool|
       - Whether to use all maps, even if the pilots show that they do not pay. (Default: false)
     * - pilot_spp
       - |int|
       - Number of pilot samples per pixel, from which the integrator learns; at most half of all
         samples (a quarter, if there are fewer than 8). They count towards the image. With 0, or
         fewer than 4 samples, nothing is learned. (Default: 64)
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
         aovs.

    **Use it when** most noise comes from a decision for which neighbouring pixels have the same
    best choice, and that nothing else samples well: fast objects in front of a dark background,
    small lights out of focus, lamps with spectral lines, beams in fog (single scattering), dozens
    of lights that shine on different places, reflections in panes of glass. **Not when** the noise
    comes from many bounces (use :monosp:`pss_guided`), or when an image has fewer than 8 samples
    per pixel.

    The first pilot has one sample per pixel, and each later pilot has as many as all earlier pilots
    together. If the render has few samples, the first pilot is divided into parts: each part
    contains as many pixels as all earlier parts together, and uses the maps learned from them. With
    a stratified sampler, it is not divided. Samples have weights that are fixed before the render.
    Samples of the first pilots, whose maps are poor, have smaller weights. The weights are chosen
    such that the variance is at most 1.5 % higher if no map helps.

    The edge of a tile is the smallest power of two with which the tile has at least 64 pilot
    samples, and at least one for each cell of its maps: 4 pixels for a map of 64 times, and 8
    pixels for a map of 32 x 32 points of the aperture, at 16 and 32 samples per pixel. Until all
    pilot samples are taken, tiles are up to twice as large. Distances have maps of 128 cells. The
    maps of one decision have at most 8 million cells, which take 96 MiB, and some hundreds of MiB
    more while they are estimated. Lights and points on them have one joint map, of at most 2048
    cells. The choice of a lobe has maps of 32 cells for each bounce, and separate ones for zero,
    one, and more reflections before it. Maps of directions, over height and angle around the z
    axis, are combined with the BSDF by multiple importance sampling. The estimate of a tile is
    drawn towards the estimate of the larger tiles around it, to the degree that chance explains
    their difference; if little is known, the density is wider. The samples of each pilot show which
    density would have been best (proportional to the mean contribution of a cell, with 5 % of
    uniform numbers, or to its square root, with 20 %), and by how much it reduces the variance. A
    map that reduces the variance by less than 10 % is not used, and is dropped after 4 samples per
    pixel. After a render, :monosp:`integrator.statistics.learned` describes what was learned, and
    :monosp:`mitsuba_ext.techniques.swarming.pixel_maps` returns the maps of a pixel as arrays (see
    examples/swarm_maps.py).

    Participating media are rendered as in :monosp:`volpath`. Gradients are not supported (use
    :monosp:`prb`); neither are scalar and polarized variants. Nested in :monosp:`moment`, it takes
    no pilot samples.

    Source: D. Cline, PhD dissertation, BYU 2007, chapter 9 (Tables 9.1 and 9.2). The source keeps
    the maps of two rows of pixels, and averages the maps of seven neighbours in the order of
    rendering. Passes and tiles, which learn from neighbours on all sides, the estimate, and the
    measurement of the gain are ours. Maps of wavelengths, which the source proposes, are also ours.

    .. tabs::
        .. code-tab:: xml

            <integrator type="swarm_path">
                <integer name="max_depth" value="8"/>
                <boolean name="lens_map" value="false"/>
            </integrator>

        .. code-tab:: python

            'type': 'swarm_path',
            'max_depth': 8,
            'lens_map': False
    """

    can_clamp = True

    def __init__(self, props: mi.Properties) -> None:
        super().__init__(props)
        always = self.parameter(props, "always_use", False)
        is_wanted = {
            key: self.parameter(props, key, key not in _OFF_BY_DEFAULT) for key in _SLOTS
        }
        # Slots are filled even if the scene does not use their numbers
        self.fill(
            props,
            caustics=read_slot(self.name, props, "caustics"),
            **{
                slot: _MAPS[slot](self.reader(props), always)
                for key, slot in _SLOTS.items()
                if is_wanted[key]
            },
        )
