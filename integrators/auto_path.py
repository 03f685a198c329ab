"""Path tracing that decides by itself what to learn."""

from __future__ import annotations

import mitsuba as mi

from mitsuba_ext.bases.slots import auto_techniques, read_slot
from mitsuba_ext.bases.walk_integrator import WalkIntegrator
from mitsuba_ext.startup import registry


@registry.plugin
class AutoPath(WalkIntegrator):
    r"""
    .. _integrator-auto_path:

    Self-configuring path tracer (:monosp:`auto_path`)
    --------------------------------------------------

    A path tracer that chooses its techniques itself: guided directions or focal points, learned
    lights, and maps of the times, lens points, wavelengths and distances in fog with which paths
    find light. Its first samples test which of them reduce the noise of this scene by more than
    they cost, and it keeps those.

    .. pluginparameters::

     * - pilot_spp
       - |int|
       - Number of pilot samples per pixel, from which the integrator learns; at most an eighth of
         all samples up to 262144 pilot samples, a sixteenth beyond, and a quarter in short renders.
         They count towards the image. With 0, it learns nothing and renders as :monosp:`path` does,
         with a light tree. (Default: 32; 0 in renders of fewer than 262144 samples)
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
       - Whether paths also connect to lights through smooth glass and mirrors, as in
         :class:`composed_path`: never (:monosp:`scattered`), always (:monosp:`manifold`, or
         :monosp:`bounded_manifold`, which is **biased**), or where pilots find that it pays
         (:monosp:`automatic`, which may choose wrongly). Except with :monosp:`scattered`, focal
         points are not tried. (Default: scattered)
     * - (Common parameters)
       - |several|
       - The parameters of :class:`WalkIntegrator`: max_depth, rr_depth, hide_emitters, timeout,
         aovs, checkpoint.

    **Use it when** you do not know which technique a scene needs, and render 16 or more samples per
    pixel. **Not when** an image has fewer samples (too few to learn from), or when small lamps
    shine through glass (camera paths do not find their light).

    Renders of fewer than 262144 samples (33554432 on a GPU) learn nothing, and choose among several
    lights by a light tree, unless the scene gives a :monosp:`pilot_spp` of 1 or more, or what is
    learned is saved or kept: learning, and compiling its kernels, would take longer than rendering
    all samples.

    It is :monosp:`composed_path` with :monosp:`directions=guided`, :monosp:`scattering=focal`,
    :monosp:`next_event=contribution`, and the word :monosp:`swarm` in the slots :monosp:`time`,
    :monosp:`aperture`, :monosp:`wavelength` and :monosp:`distance`; the pages of
    :monosp:`guided_directions`, :monosp:`focal_points`, :monosp:`learned_lights` and
    :monosp:`swarm_path` describe what is learned, and how. Focal points are used in place of guided
    directions, where they gain more. The maps are used in scenes with an open shutter, a lens or
    fog, and in spectral variants; otherwise they cost nothing. The first two pilots are short.
    Together they predict how much each technique reduces the variance of the image, and a technique
    that costs more time than it saves is dropped then. The maps of lobes and of directions of
    :monosp:`swarm_path` are not tried, because guided directions take their place.
    :monosp:`integrator.statistics.learned` says which techniques were kept, and why.

    Participating media are rendered as in :monosp:`volpath`. Gradients are not supported (use
    :monosp:`prb`); neither are scalar and polarized variants. Nested in :monosp:`moment`, it takes
    no pilot samples.

    Sources: see :monosp:`guided_directions`, :monosp:`focal_points`, :monosp:`learned_lights` and
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

    can_clamp = learns_if_long = True

    def __init__(self, props: mi.Properties) -> None:
        super().__init__(props)
        techniques, caustics = auto_techniques(self.name), read_slot(self.name, props, "caustics")
        if caustics is not None:
            techniques.pop("scattering", None)  # these connections know the densities of BSDFs only
        self.fill(props, caustics=caustics, **techniques)
