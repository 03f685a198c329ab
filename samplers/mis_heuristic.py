"""Heuristics of multiple importance sampling."""

from __future__ import annotations

from mitsuba_ext.bases.decision_plugin import DecisionPlugin
from mitsuba_ext.startup import registry
from mitsuba_ext.techniques.mis.parameters import MisHeuristic


@registry.plugin
class MisHeuristicPlugin(DecisionPlugin):
    r"""
    .. _sampler-mis_heuristic:

    Heuristic of multiple importance sampling (:monosp:`mis_heuristic`)
    -------------------------------------------------------------------

    A decision for the slot :monosp:`mis` of :monosp:`composed_path`. Two techniques find the same
    light: connections to it, and BSDF samples that hit it. The heuristic weights both by their
    densities, so that the image is unbiased.

    .. pluginparameters::

     * - heuristic
       - |string|
       - :monosp:`power` (weights in proportion to a power of the densities), :monosp:`balance` (to
         the densities), :monosp:`cutoff` (as balance, but a density that is much smaller than the
         other one has no weight), :monosp:`maximum` (the larger density has all weight),
         :monosp:`bsdf` (BSDF samples alone; light that they cannot find is connected to all the
         same), or :monosp:`light` (connections alone; what they cannot find is left to BSDF
         samples). (Default: power)
     * - exponent
       - |float|
       - Of :monosp:`power`, 1 to 64. (Default: 2)
     * - threshold
       - |float|
       - Of :monosp:`cutoff`: a density below this share of the other one has no weight, 0 to 1.
         (Default: 0.1)

    **Use it when** you compare heuristics, or teach. **Not when** you want low noise without
    experiments: :monosp:`power` with the exponent 2, which :monosp:`path` uses, is seldom much
    worse than any other.

    Connections whose weight is 0 trace no shadow ray. Paths continue in the directions of their
    BSDF samples, also if these have the weight 0.

    Source: E. Veach, PhD thesis, 1997, section 9.2; H. W. Jensen et al., *Monte Carlo Ray Tracing*,
    SIGGRAPH 2003 course 44, sections 5.3 and 5.4.

    .. tabs::
        .. code-tab:: xml

            <integrator type="composed_path">
                <sampler name="mis" type="mis_heuristic">
                    <string name="heuristic" value="cutoff"/>
                    <float name="threshold" value="0.2"/>
                </sampler>
            </integrator>

        .. code-tab:: python

            'type': 'composed_path',
            'mis': {
                'type': 'mis_heuristic',
                'heuristic': 'cutoff',
                'threshold': 0.2
            }

        .. code-tab:: bash

            mitsuba-ext render scene.xml -o image.exr --integrator \
                "composed_path:mis=[mis_heuristic:heuristic=cutoff,threshold=0.2]"
    """

    kind = MisHeuristic
