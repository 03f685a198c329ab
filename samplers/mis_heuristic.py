"""Heuristics of multiple importance sampling."""

from __future__ import annotations

from mitsuba_ext.bases.decision_plugin import DecisionPlugin
from mitsuba_ext.startup import registry
from mitsuba_ext.techniques.mis.parameters import MisHeuristic


@registry.plugin
class MisHeuristicPlugin(DecisionPlugin):
    r"""
    .. _sampler-mis_heuristic:

    Multiple importance sampling heuristic (:monosp:`mis_heuristic`)
    ----------------------------------------------------------------

    A decision for the slot :monosp:`mis` of :monosp:`composed_path`. Two techniques find the same
    light: connections to it, and BSDF samples that hit it. The heuristic weights both by their
    densities in a way that keeps the image unbiased.

    .. pluginparameters::

     * - heuristic
       - |string|
       - :monosp:`power` (weights proportional to a power of the densities), :monosp:`balance`
         (weights proportional to the densities), :monosp:`cutoff` (as balance, but a technique
         whose density is much smaller than the other one has weight 0), :monosp:`maximum` (the
         technique with the larger density has weight 1), :monosp:`bsdf` (BSDF samples only, with
         connections to light that they cannot find), or :monosp:`light` (connections only, with
         BSDF samples for light that connections cannot find). (Default: power)
     * - exponent
       - |float|
       - The exponent of :monosp:`power`, 1 to 64. (Default: 2)
     * - threshold
       - |float|
       - The threshold of :monosp:`cutoff`, 0 to 1: a technique whose density is below this fraction
         of the other one has weight 0. (Default: 0.1)

    **Use it when** you compare heuristics, or teach. **Not when** you want low noise without
    experiments: :monosp:`power` with exponent 2, which :monosp:`path` uses, is seldom much worse
    than any other heuristic.

    Connections whose weight is 0 trace no shadow ray. Paths continue in the directions of their
    BSDF samples, even if these have weight 0.

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
