"""Sample swarming."""

from __future__ import annotations

import mitsuba as mi

from mitsuba_ext.composition.swarm import MAPS
from mitsuba_ext.composition.walk_integrator import WalkIntegrator
from mitsuba_ext.startup import registry

#: By parameter, the slot that its maps fill.
_SLOTS = {
    "time_map": "time", "lens_map": "aperture", "wavelength_map": "wavelength",
    "distance_map": "distance", "light_map": "light_numbers", "lobe_map": "directions",
    "direction_map": "scattering",
}  # fmt: skip

#: Maps that pay too little for their time.
_OFF_BY_DEFAULT = ("direction_map",)


@registry.plugin
class SwarmPath(WalkIntegrator):
    r"""
    .. _integrator-swarm_path:

    Sample swarming (:monosp:`swarm_path`)
    --------------------------------------

    A path tracer whose pixels tell their neighbours which random numbers found light. For each
    kind of decision, every tile of the film has a map: a table of probabilities over the numbers
    that take the decision, learned from the samples of the image itself. It is unbiased, and uses
    only the maps that pay. It is :monosp:`composed_path` with the word :monosp:`swarm` in several
    slots.

    .. pluginparameters::

     * - time_map
       - |bool|
       - Learn at which times of the shutter interval light comes? (Default: true)
     * - lens_map
       - |bool|
       - Learn through which parts of the aperture? (Default: true)
     * - wavelength_map
       - |bool|
       - Learn at which wavelengths? It has an effect in spectral variants. (Default: true)
     * - distance_map
       - |bool|
       - Learn at which distances in a homogeneous medium camera rays find light? (Default: true)
     * - light_map
       - |bool|
       - Learn which light, and which point of it, the first connection of a path is to go to?
         (Default: true)
     * - lobe_map
       - |bool|
       - Learn whether to be reflected or transmitted, at the first eight bounces? A fifth of the
         paths draws uniform numbers at all bounces, and paths are weighted by the balance
         heuristic, so that none weighs more than five times what it would. (Default: true)
     * - direction_map
       - |bool|
       - Learn from which directions light comes to the first vertex that is no mirror? Half of its
         directions are chosen by the map. Off by default: it pays where light comes
         from a small bright patch (scenes/bounce_card.xml), and seldom elsewhere. (Default: false)
     * - always_use
       - |bool|
       - Use all maps, also where the pilots show that it does not pay? (Default: false)
     * - pilot_spp
       - |int|
       - Samples per pixel from which is learned, at most half of all, and a quarter of fewer than
         8. They count towards the image. With 0, or fewer than 4 samples, nothing is learned.
         (Default: 64)
     * - save_learned, load_learned
       - |string|
       - Files. The first is written: what was learned, as a whole. The second is read in place of
         pilots: what a render of the same scene, with the same parameters and size of film, has
         saved. (Default: none)
     * - (Common parameters)
       - |several|
       - Those of :class:`WalkIntegrator`: max_depth, rr_depth, hide_emitters, timeout, aovs.

    **Use it when** most noise comes from a decision that neighbouring pixels take alike, and that
    nothing else samples well: fast things before a dark background, small lights out of focus,
    lamps with spectral lines, beams in fog (as far as their light scatters once), dozens of lights
    that shine on different places, reflections in panes of glass. **Not when** the noise is that of
    many bounces (use :monosp:`pss_guided`), or when an image has fewer than 8 samples per pixel.

    The first pilot has one sample per pixel, and each pilot as many as all before it. Where samples
    are few, the first pilot is divided: a part of the pixels takes its sample, then as many others,
    and so on, each from the maps of all before. All samples count with weights that are fixed
    before the render: less in the first pilots, whose maps are poor, as long as that costs no
    more than 1.5 % where no map helps. Pilots are not divided with a structured sampler.

    The edge of a tile is the power of two with which it has at least 64 samples of all pilots, and
    one for each cell of its maps: 4 pixels for a map of 64 times and 8 for one of 32 x 32 points of
    the aperture, at 16 and 32 samples per pixel. Before all pilots are taken, tiles are up to twice
    as large. Distances have maps of 128 cells. A map has 8 million cells at most, which take
    96 MiB; while it is estimated, some hundreds more. Lights and points on them have one joint
    map, of 2048 cells at most; the choice of a lobe has maps of 32 cells for each bounce and for
    no, one, and more reflections before; directions are mixed with those of the BSDF (multiple
    importance sampling), by height and angle around the z axis. What a tile has found is drawn to
    what larger tiles around it have found, as far as the differences are no more than chance; where
    little is known, the density is wider. From the samples of each pilot follows which density
    would have been best (in proportion to the mean of what a cell brings, with 5 % of uniform
    numbers, or to its root, with 20 %), and by how much the variance is lower: below 10 %, a map is
    not used, and after 4 samples per pixel it is given up. After a render,
    :monosp:`integrator.statistics.learned` tells what was found, and
    :monosp:`mitsuba_ext.composition.pixel_maps` has the maps of a pixel as arrays (see
    examples/swarm_maps.py).

    Participating media are rendered as by :monosp:`volpath`. Gradients are not supported (use
    :monosp:`prb`), nor are scalar and polarized variants. Nested in :monosp:`moment` there is no
    pilot.

    Source: D. Cline, PhD dissertation, BYU 2007, chapter 9 (Tables 9.1 and 9.2). The source keeps
    the maps of two rows of pixels, and averages those of seven neighbours in the order of
    rendering; passes and tiles, which hear from all sides, the estimate, and the measurement of the
    gain are ours, as are maps of wavelengths, which it proposes.

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

    def __init__(self, props: mi.Properties) -> None:
        super().__init__(props)
        always = self.parameter(props, "always_use", False)
        is_wanted = {
            key: self.parameter(props, key, key not in _OFF_BY_DEFAULT) for key in _SLOTS
        }
        self._shown = {**is_wanted, "always_use": always}
        # Every slot is filled, also those whose numbers the scene does not ask for
        self.fill(
            props,
            **{
                slot: MAPS[slot](self.reader(props), always)
                for key, slot in _SLOTS.items()
                if is_wanted[key]
            },
        )

    def parameters(self):
        return {**super().parameters(), **self._shown}
