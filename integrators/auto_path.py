"""Path tracing that decides by itself what to learn."""

from __future__ import annotations

import mitsuba as mi

from mitsuba_ext.composition.decision_parameters import ParameterReader
from mitsuba_ext.composition.directions import Guided
from mitsuba_ext.composition.next_event import LearnedLights
from mitsuba_ext.composition.roulette import GuidedRoulette
from mitsuba_ext.composition.swarm import MAPS
from mitsuba_ext.composition.walk_integrator import WalkIntegrator
from mitsuba_ext.startup import registry

#: The numbers of a camera ray that can have maps.
_CAMERA_NUMBERS = ("time", "aperture", "wavelength", "distance")


@registry.plugin
class AutoPath(WalkIntegrator):
    r"""
    .. _integrator-auto_path:

    Self-configuring path tracer (:monosp:`auto_path`)
    --------------------------------------------------

    A path tracer that tries in its first samples whether guiding directions, learning lights, and
    learning which times, points of the lens, wavelengths and distances in fog find light pay in
    this scene, and keeps what does. There is nothing to choose.

    .. pluginparameters::

     * - pilot_spp
       - |int|
       - Samples per pixel from which is learned, at most a quarter of all. They count towards the
         image. With 0 nothing is learned, and this is :monosp:`path`. (Default: 32)
     * - save_learned, load_learned
       - |string|
       - Files. The first is written: what was learned, as a whole. The second is read in place of
         pilots: what a render of the same scene, with the same parameters and size of film, has
         saved. (Default: none)
     * - (Common parameters)
       - |several|
       - Those of :class:`WalkIntegrator`: max_depth, rr_depth, hide_emitters, timeout, aovs,
         checkpoint.

    **Use it when** you do not know which technique a scene needs, with 16 samples per pixel or
    more. **Not when** an image has fewer samples (there is nothing to learn from), or when light
    comes through glass from small lamps (no path from the camera finds it).

    It is a :monosp:`composed_path` with :monosp:`directions=guided`,
    :monosp:`next_event=contribution`, and the word :monosp:`swarm` in the slots :monosp:`time`,
    :monosp:`aperture`, :monosp:`wavelength` and :monosp:`distance`; :monosp:`guided_directions`,
    :monosp:`learned_lights` and :monosp:`swarm_path` tell what is learned, and how. Maps are for
    scenes with an open shutter, a lens, fog, or in spectral variants, and cost nothing elsewhere.
    The first two pilots are short: together they predict by how much each of these lowers the
    variance of the image. What costs more time than it saves ends there. Maps of reflections and of
    directions are not tried: guided directions have their place.
    :monosp:`integrator.statistics.learned` says what was kept, and why.

    Participating media are rendered as by :monosp:`volpath`. Gradients are not supported (use
    :monosp:`prb`), nor are scalar and polarized variants. Nested in :monosp:`moment` there is no
    pilot.

    Sources: those of :monosp:`guided_directions`, :monosp:`learned_lights` and
    :monosp:`swarm_path`. The predictions are ours.

    .. tabs::
        .. code-tab:: xml

            <integrator type="auto_path">
                <integer name="max_depth" value="8"/>
            </integrator>

        .. code-tab:: python

            'type': 'auto_path',
            'max_depth': 8
    """

    def __init__(self, props: mi.Properties) -> None:
        super().__init__(props)
        read = ParameterReader.of_defaults(self.name)
        self.fill(
            props,
            directions=Guided(read),
            next_event=LearnedLights(read),
            roulette=GuidedRoulette(),
            # They do not ask for longer pilots
            **{slot: MAPS[slot](read, pilot_spp=Guided.pilot_spp) for slot in _CAMERA_NUMBERS},
        )
