"""Connections of a vertex to many points on lights, from weighted sets."""

from __future__ import annotations

from mitsuba_ext.bases.decision_plugin import DecisionPlugin
from mitsuba_ext.startup import registry
from mitsuba_ext.techniques.weighted_points.connections import Connections


@registry.plugin
class WeightedConnectionsPlugin(DecisionPlugin):
    r"""
    .. _sampler-weighted_connections:

    Weighted connections (:monosp:`weighted_connections`)
    -----------------------------------------------------

    A decision for the slot :monosp:`connections` of :monosp:`composed_path`. It connects a vertex
    to many points on lights, whose random numbers come from well distributed point sets. Each
    connection can be weighted by the Voronoi cell of its point. :monosp:`reweighted_direct` is a
    path tracer with this decision.

    .. pluginparameters::

     * - count
       - |int|
       - Number of points in a set, which is the number of connections of a vertex; at most 4096
         (1024 with :monosp:`poisson_disk`). With 0, light is found by BSDF samples only; point
         lights and parallel light are connected to in any case. (Default: 16)
     * - vertices
       - |string|
       - Which vertices of a path have this many connections: the :monosp:`first` (later ones have
         one), or :monosp:`all`. (Default: first)
     * - pattern
       - |string|
       - How the points of a set are distributed: :monosp:`independent`, :monosp:`stratified`,
         :monosp:`latin_hypercube`, :monosp:`halton`, :monosp:`hammersley`, :monosp:`sobol`,
         :monosp:`lattice` or :monosp:`poisson_disk`; see
         :monosp:`mitsuba_ext.util.pointsets.points`. (Default: hammersley)
     * - weights
       - |string|
       - Weights of the points: :monosp:`none` (all equal), :monosp:`torus` (areas of periodic
         Voronoi cells: unbiased), :monosp:`unbiased` (the same, with points mapped by
         ``1 - |2u - 1|``, which removes discontinuities at the border), or :monosp:`voronoi`
         (cells that end at the border, as in the thesis: slightly biased). (Default: none)

    **Use it when** the noise comes from soft shadows and large lights, and edges, defocus or
    materials do not need many camera samples. **Not when** most light is indirect, or the noise
    comes from edges: more camera samples then reduce it further. Compare it with a
    :monosp:`multijitter` sampler of the sensor, which is hard to beat.

    Each vertex shifts its set around the torus at random (not with :monosp:`voronoi` weights), so
    the errors of neighbouring pixels are independent. Multiple importance sampling combines these
    :monosp:`count` connections with one BSDF sample. They can be combined with every
    :monosp:`next_event`: if it uses additional random numbers to choose the light, these come from
    a lattice, and the set chooses points on the lights. 16 connections take about as long as a
    path.

    Source: J. J. Guo, PhD thesis, TU Delft, sections 4.4 and 4.5.2.4. Periodic cells, which are
    unbiased, are our addition.

    .. tabs::
        .. code-tab:: xml

            <integrator type="composed_path">
                <sampler name="connections" type="weighted_connections">
                    <integer name="count" value="64"/>
                    <string name="weights" value="unbiased"/>
                </sampler>
            </integrator>

        .. code-tab:: python

            'type': 'composed_path',
            'connections': {
                'type': 'weighted_connections',
                'count': 64,
                'weights': 'unbiased'
            }

        .. code-tab:: bash

            mitsuba-ext render scene.xml -o image.exr --integrator \
                "composed_path:connections=[weighted_connections:count=64,weights=unbiased]"
    """

    kind = Connections
