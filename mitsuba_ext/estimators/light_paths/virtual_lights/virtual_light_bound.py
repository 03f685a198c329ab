"""How the light of virtual point lights is bounded, and how a camera path compensates for it.

The kernel of a connection to a virtual light has a weak singularity: it grows with 1 / distance².
A connection therefore counts at most as if its kernel were the bound b. The rest is found where the
camera path goes on by BSDF sampling: what leaves its next vertex towards the last one counts with
the weight max(0, 1 − b / kernel), and so on recursively. Both weights add up to one for each path.

On diffuse surfaces, the kernel is the geometry term G = cos cos' / distance². Elsewhere, π times
the density of BSDF samples takes the place of the cosine at the camera path's vertex, and where the
virtual light scatters light into a narrow lobe, the kernel also contains π times the density there:
glossy reflections, which virtual lights render badly, are left to the camera path. The estimate
stays unbiased with any kernel that both sides compute alike.

Source: T. Kollig, A. Keller, *Illumination in the Presence of Weak Singularities*, Monte Carlo and
Quasi-Monte Carlo Methods 2004, section 3.
"""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi

from ....transport.path_decisions import (
    LARGEST_PROBABILITY,
    SubpathSelection,
    unguided_throughput,
)
from ....transport.path_program import EndingProgram, Subpaths
from ..both_ends import from_both_ends


def is_connected(bsdf: mi.BSDFPtr) -> mi.Bool:
    """Whether the BSDF has a part that is not a delta distribution. Virtual lights lie on such
    surfaces, and camera paths are connected to them from such surfaces."""
    return mi.has_flag(bsdf.flags(), mi.BSDFFlags.Smooth)


@dataclass
class Link:
    """What a camera path remembers about virtual lights.

    Attributes:
        share: The product of the weights of all earlier segments.
        kernel: The part of the last segment's kernel that does not depend on how the path goes on;
            infinite if no virtual light could have found the segment.
        plain: The same for the geometry term alone.
        connects: Whether the last vertex was connected to virtual lights, and the path left it in a
            direction in which they can lie.
        region: The region in which the last vertex lies; ``None`` if virtual lights are not chosen
            by regions.
    """

    share: mi.Float
    kernel: mi.Float
    plain: mi.Float
    connects: mi.Bool
    region: mi.UInt32 | None = None


class Bound:
    """The weights of both sides.

    Parameters:
        bound: The largest kernel, in 1 / length².
        compensates: Whether the camera path makes up for all light that the bound cuts off. If not,
            it makes up only for what is cut off because surfaces are glossy.

    Attributes:
        largest (mi.Float): The largest kernel.
    """

    def __init__(self, bound: float, compensates: bool) -> None:
        self.largest, self._compensates = dr.opaque(mi.Float, bound), compensates

    def connected(self, kernel: mi.Float, far_pdf: mi.Float) -> mi.Float:
        """The weight of a connection.

        Parameters:
            kernel: See :class:`Link`.
            far_pdf: The density with which a camera path that arrives at the virtual light goes on
                to where its light comes from.
        """
        return self._bounded(kernel * dr.maximum(1, dr.pi * far_pdf))

    def share(self, link: Link, bsdf: mi.BSDFPtr, pdf: mi.Float) -> mi.Float:
        """The weight of what a camera path finds at its vertex, in a direction of density
        ``pdf``."""
        within = self.connected(link.kernel, pdf)
        rest = 1 - within
        if not self._compensates:
            rest = dr.maximum(0, self._bounded(link.plain) - within)
        # No virtual light lies on a mirror
        found_twice = dr.isfinite(link.kernel) & is_connected(bsdf)
        return link.share * dr.select(found_twice, rest, 1)

    def _bounded(self, kernel: mi.Float) -> mi.Float:
        return dr.select(kernel > self.largest, self.largest / kernel, 1)


class CompensatingPaths(EndingProgram):
    """Camera paths that are connected to virtual lights. They find what the bound cuts off from
    virtual lights; in Russian roulette, the share of the path counts like its throughput, at each
    depth.

    Parameters:
        bound: The weights of both sides.
        selection: Chooses the regions of virtual lights, if they are chosen by regions.
        subpaths: The virtual lights; ``None`` if there are none.
    """

    def __init__(
        self,
        bound: Bound,
        selection: SubpathSelection | None = None,
        subpaths: Subpaths | None = None,
    ) -> None:
        self.bound, self._selection, self.subpaths = bound, selection, subpaths

    def begin(self, ray):
        region = None if self._selection is None else mi.UInt32(0)
        return Link(mi.Float(1), mi.Float(dr.inf), mi.Float(dr.inf), mi.Bool(False), region)

    def arrive(self, path, si, in_medium):
        link, arrival = path.history, path.arrival
        d = si.p - arrival.ref.p
        squared = dr.squared_norm(d)
        # Positive wherever the result is used: a ray has found the surface
        inverse = dr.rcp(dr.maximum(squared, dr.smallest(mi.Float)))
        length = dr.sqrt(inverse)
        cosine = dr.abs(dr.dot(si.n, d)) * length
        leaves = dr.abs(dr.dot(arrival.ref.n, d)) * length
        kernel = dr.pi * arrival.pdf * cosine * inverse
        found = link.connects & si.is_valid()
        region = None
        if self._selection is not None:
            region = self._selection.region(from_both_ends(si), si.is_valid())
        return Link(
            link.share,
            dr.select(found, kernel, dr.inf),
            dr.select(found, leaves * cosine * inverse, dr.inf),
            link.connects, region,
        )  # fmt: skip

    def emission(self, weights, scene, si, ds, path, pdf):
        # Light that reaches the last vertex directly from a lamp belongs to no virtual light
        return super().emission(weights, scene, si, ds, path, pdf) * path.history.share

    def connection(self, weights, scene, vertex, ds, pdf, scattering_pdf):
        weight = super().connection(weights, scene, vertex, ds, pdf, scattering_pdf)
        return weight * self.bound.share(vertex.path.history, vertex.bsdf, scattering_pdf)

    def leave(self, vertex, bs):
        link = vertex.path.history
        scatters = ~mi.has_flag(bs.sampled_type, mi.BSDFFlags.Delta)
        # A virtual light does not shine into a delta lobe
        share = dr.select(scatters, self.bound.share(link, vertex.bsdf, bs.pdf), link.share)
        connects = scatters & is_connected(vertex.bsdf)
        return Link(share, link.kernel, link.plain, connects, link.region)

    def survival(self, roulette, state, vertex, path, late, active):
        before, after = vertex.path.history.share, path.history.share
        change = dr.select(before > 0, after / before, 0)
        by_throughput = dr.minimum(unguided_throughput(path) * after, LARGEST_PROBABILITY)
        return dr.select(late, dr.minimum(by_throughput, change), change), state
