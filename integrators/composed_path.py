"""The random walk itself, with its decisions chosen in the scene."""

from __future__ import annotations

from typing import Any

import mitsuba as mi

from mitsuba_ext import registry
from mitsuba_ext.composition.slots import SLOTS, read_slot
from mitsuba_ext.composition.walk_integrator import WalkIntegrator


@registry.plugin
class ComposedPath(WalkIntegrator):
    r"""
    .. _integrator-composed_path:

    Composed path tracer (:monosp:`composed_path`)
    ----------------------------------------------

    A path tracer whose decisions are chosen in the scene. With all defaults it is Mitsuba's
    :monosp:`path` (with the same random numbers and the same image, while one pass of two million
    samples is enough), but traces no shadow ray for connections that cannot contribute. Where
    Mitsuba 3.9.1 misjudges the bounds of a scene (rectangles of one material, which it merges), sky
    and sun leak through walls in :monosp:`path`, and not here.

    .. pluginparameters::

     * - next_event
       - |string|
       - How a light is chosen at each vertex: :monosp:`uniform` (as :monosp:`path` does),
         :monosp:`power`, :monosp:`spatial`, :monosp:`linear`, :monosp:`visibility` or
         :monosp:`contribution`; see the parameter light_sampling of :monosp:`neepp`.
         (Default: uniform)
     * - shadow_test
       - |string|
       - Whether the shadow ray of a connection is traced: :monosp:`always`, or
         :monosp:`visibility_roulette` (by learned visibility, see :monosp:`neepp`).
         (Default: always)
     * - grid, max_memory, pilot_spp, law, slope, floor, refine, save_map, load_map
       - |several|
       - Those of :monosp:`neepp`; known only where next_event or shadow_test is not the default.
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
       - Seconds after which to stop, compilation included; 0 or less for no limit. The number of
         samples follows from the speed of the first passes (short ones, until one compiles nothing,
         and then one of a quarter of the time left), and not from the clock, so that stopping does
         not prefer fast samples. The time is kept as well as the speed is steady; a short pass is
         always taken. (Default: -1)
     * - aovs
       - |string|
       - Arbitrary output variables, in the syntax of Mitsuba's :monosp:`aov` integrator, such as
         :monosp:`depth:depth,nn:sh_normal`. (Default: none)

    **Use it when** you want :monosp:`path` with passes of bounded memory, a time budget, statistics
    or progress, or to combine techniques. **Not when** you need gradients (use :monosp:`prb`),
    participating media (use :monosp:`volpath`; they are ignored here, as by :monosp:`path`), or a
    scalar or polarized variant.

    Source: the algorithm is that of Mitsuba's :monosp:`path`; J. T. Kajiya, *The Rendering
    Equation*, 1986; E. Veach, PhD thesis, 1997, chapter 9 (multiple importance sampling).

    .. tabs::
        .. code-tab:: xml

            <integrator type="composed_path">
                <integer name="max_depth" value="8"/>
                <string name="shadow_test" value="visibility_roulette"/>
            </integrator>

        .. code-tab:: python

            'type': 'composed_path',
            'max_depth': 8,
            'shadow_test': 'visibility_roulette'
    """

    def __init__(self, props: mi.Properties) -> None:
        super().__init__(props)
        self.fill(props, **{slot: read_slot(self.name, props, slot) for slot in SLOTS})

    def parameters(self) -> dict[str, Any]:
        defaults = {slot: next(iter(words)) for slot, words in SLOTS.items()}
        return {**defaults, **super().parameters()}
