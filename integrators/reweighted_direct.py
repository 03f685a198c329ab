"""Direct light from weighted sets of light samples."""

from __future__ import annotations

import mitsuba as mi

from mitsuba_ext.bases.walk_integrator import WalkIntegrator
from mitsuba_ext.startup import registry
from mitsuba_ext.techniques.weighted_points.connections import Connections


@registry.plugin
class ReweightedDirect(WalkIntegrator):
    r"""
    .. _integrator-reweighted_direct:

    Reweighted light samples (:monosp:`reweighted_direct`)
    ------------------------------------------------------

    A path tracer that connects the first vertex of each path to many points on lights. The points
    come from well distributed point sets, and each connection can be weighted by the Voronoi cell
    of its point. Later vertices of a path are connected to one point each, as in :monosp:`path`. It
    is :monosp:`composed_path` with :monosp:`weighted_connections`, whose page has the details.

    .. pluginparameters::

     * - light_samples
       - |int|
       - Number of points in a set, which is the number of connections of the first vertex; at most
         4096 (1024 with :monosp:`poisson_disk`), because beyond that, more camera samples are a
         better use of the time. With 0, the first vertex finds light by BSDF samples only.
         (Default: 256)
     * - vertices
       - |string|
       - Which vertices have this many connections: the :monosp:`first`, or :monosp:`all`. (Default:
         first)
     * - pattern
       - |string|
       - How the points of a set are distributed: :monosp:`independent`, :monosp:`stratified`,
         :monosp:`latin_hypercube`, :monosp:`halton`, :monosp:`hammersley`, :monosp:`sobol`,
         :monosp:`lattice` or :monosp:`poisson_disk`. (Default: hammersley)
     * - weights
       - |string|
       - Weights of the points: :monosp:`none`, :monosp:`torus`, :monosp:`unbiased` or
         :monosp:`voronoi` (slightly biased). (Default: none)
     * - camera_samples
       - |int|
       - Samples per pixel of a render without :monosp:`spp`; 0 for the number of the sensor's
         sampler, which is 4 by default. It has no effect if this integrator is nested in another
         one. (Default: 0)
     * - clamp_direct, clamp_indirect
       - |float|
       - **Biased**: the largest light of a sample, see :class:`composed_path`. 0 clamps nothing.
         (Default: 0)
     * - (Common parameters)
       - |several|
       - The parameters of :class:`WalkIntegrator`: max_depth, rr_depth, hide_emitters, timeout,
         aovs, checkpoint.

    **Use it when** the noise comes from soft shadows and large lights, and edges, defocus or
    materials do not need many camera samples. **Not when** most light is indirect (more camera
    samples reduce its noise more), or with many lights (use :monosp:`neepp`). Compare it with
    :monosp:`path` and a :monosp:`multijitter` sampler, which is hard to beat.

    Participating media are rendered as in :monosp:`volpath`. Gradients are not supported (use
    :monosp:`prb`); neither are scalar and polarized variants.

    Source: J. J. Guo, PhD thesis, TU Delft, sections 4.4 and 4.5.2.4. Periodic cells, which are
    unbiased, are our addition.

    .. tabs::
        .. code-tab:: xml

            <integrator type="reweighted_direct">
                <integer name="light_samples" value="64"/>
            </integrator>

        .. code-tab:: python

            'type': 'reweighted_direct',
            'light_samples': 64
    """

    can_clamp = True

    def __init__(self, props: mi.Properties) -> None:
        super().__init__(props)
        self.camera_samples = self.parameter(props, "camera_samples", 0, minimum=0)
        read = self.reader(props, {"count": "light_samples"}, count=256)
        self.fill(props, connections=Connections(read))

    @property
    def default_spp(self) -> int:
        return self.camera_samples
