"""Connections of a vertex to many points of lights, from weighted sets."""

from __future__ import annotations

from mitsuba_ext import registry
from mitsuba_ext.composition.connections import Connections
from mitsuba_ext.composition.decision_plugin import DecisionPlugin


@registry.plugin
class WeightedConnectionsPlugin(DecisionPlugin):
    r"""
    .. _sampler-weighted_connections:

    Weighted connections (:monosp:`weighted_connections`)
    -----------------------------------------------------

    A decision for the slot :monosp:`connections` of :monosp:`composed_path`. It connects a vertex
    to many points of lights. Their random numbers come from well distributed sets, which can be
    weighted by the cells of the points. :monosp:`reweighted_direct` is a path tracer with this
    decision.

    .. pluginparameters::

     * - count
       - |int|
       - Points of a set: connections of a vertex, at most 4096 (1024 with :monosp:`poisson_disk`).
         With 0, light is found by BSDF samples only; lights without extent are connected to all the
         same. (Default: 16)
     * - vertices
       - |string|
       - Which vertices of a path have so many connections: the :monosp:`first` (later ones have
         one), or :monosp:`all`. (Default: first)
     * - pattern
       - |string|
       - How the points of a set are distributed: :monosp:`independent`, :monosp:`stratified`,
         :monosp:`latin_hypercube`, :monosp:`halton`, :monosp:`hammersley`, :monosp:`sobol`,
         :monosp:`lattice` or :monosp:`poisson_disk`; see :monosp:`mitsuba_ext.pointsets.points`.
         (Default: hammersley)
     * - weights
       - |string|
       - How the points are weighted: :monosp:`none` (all alike), :monosp:`torus` (by the areas of
         periodic Voronoi cells: unbiased), :monosp:`unbiased` (the same, with points that are
         folded, so that opposite edges need not be alike), or :monosp:`voronoi` (by cells that end
         at the border, as in the thesis: slightly biased). (Default: none)

    **Use it when** the noise is that of soft shadows and large lights, and edges, defocus or
    materials do not ask for many camera samples. **Not when** most light is indirect, or edges make
    the noise: more camera samples serve better then. Compare it with a :monosp:`multijitter`
    sampler of the sensor, which is hard to beat.

    Each vertex moves its set around the torus at random (with :monosp:`voronoi` weights it does
    not), so that errors of neighbouring pixels do not depend on each other. The BSDF sample of the
    vertex has its share in direct light by multiple importance sampling, as one sample beside so
    many. It goes with every :monosp:`next_event`: where that chooses lights by numbers of its own,
    these come from a lattice, and the set chooses points on the lights. 16 connections take about
    as long as a path.

    Source: J. J. Guo, PhD thesis, TU Delft, sections 4.4 and 4.5.2.4; periodic cells, and that they
    are unbiased, are ours.

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
