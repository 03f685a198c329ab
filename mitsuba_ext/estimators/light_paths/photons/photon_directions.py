"""Directions of the final gather that follow the photons: half of the segments go in directions
from which photons near the vertex have come.

Source: H. W. Jensen et al., *State of the Art in Monte Carlo Global Illumination*, SIGGRAPH course,
2004, section 10.5 ("final gather"); H. W. Jensen, *Importance Driven Path Tracing Using the Photon
Map*, Eurographics Workshop on Rendering, 1995. Instead of a histogram of the hemisphere, each
photon has a lobe around its direction.
"""

from __future__ import annotations

import drjit as dr
import mitsuba as mi

from ....transport.bsdfs import eval_and_sample_bsdf, eval_bsdf
from ....transport.path_decisions import Scattering
from ....transport.vertex import Vertex
from ..light_vertices import LightVertex
from .gathering_paths import BEFORE, is_diffuse
from .photon_maps import PhotonMaps

#: Concentration of the lobe around the direction of a photon (von Mises and Fisher's κ: half of the
#: lobe lies within 15 degrees); and the share of directions that follow photons.
_CONCENTRATION, _SHARE = 20.0, 0.5


class PhotonDirections(Scattering):
    """Mixes BSDF samples with directions of photons, at the first diffuse vertex of a camera path.

    Only indirect photons that belong to no caustic count: there is no gather for other light.

    Parameters:
        maps: The photons.
    """

    def __init__(self, maps: PhotonMaps) -> None:
        self._vertices, self._grid = maps.vertices, maps.gathered.grids[0]

    def sample(self, state, ctx, vertex, wo, sample_1, sample_2):
        si, guides = vertex.si, self._guides(vertex)
        chosen, power = self._chosen(vertex, _below_one(sample_1 / _SHARE), guides)
        guides &= power > 0
        follows = guides & (sample_1 < _SHARE)

        # ----- The numbers that are left choose a lobe of the BSDF -----
        rest = _below_one((sample_1 - _SHARE) / (1 - _SHARE))
        value, pdf, bs, weight = eval_and_sample_bsdf(
            vertex.bsdf, ctx, si, wo, dr.select(guides, rest, sample_1), sample_2
        )
        bs = mi.BSDFSample3f(bs)
        near = mi.warp.square_to_von_mises_fisher(sample_2, _CONCENTRATION)
        bs.wo = dr.select(follows, mi.Frame3f(chosen).to_world(near), bs.wo)
        bs.eta = dr.select(follows, 1, bs.eta)
        bs.sampled_type = dr.select(follows, +mi.BSDFFlags.DiffuseReflection, bs.sampled_type)

        # ----- Value / density of the mixture -----
        is_delta = mi.has_flag(bs.sampled_type, mi.BSDFFlags.Delta)
        sampled, sampled_pdf = eval_bsdf(vertex.bsdf, ctx, si, bs.wo, guides & ~is_delta)
        photons, sampled_photons = self._densities(vertex, (wo, bs.wo), power, guides)
        mixed = _mixed(sampled_pdf, sampled_photons)
        # The BSDF's own sample has failed where its weight is zero
        is_sampled = follows | (dr.max(dr.abs(mi.unpolarized_spectrum(weight))) > 0)
        sampled *= dr.select(is_sampled & (mixed > 0), dr.rcp(mixed), 0)
        guided = dr.select(is_delta, weight / (1 - _SHARE), sampled)
        bs.pdf = dr.select(guides, dr.select(is_delta, bs.pdf * (1 - _SHARE), mixed), bs.pdf)
        pdf = dr.select(guides, _mixed(pdf, photons), pdf)
        return value, pdf, bs, dr.select(guides, guided, weight), state

    def eval_pdf(self, state, ctx, vertex, wo, active):
        value, pdf = eval_bsdf(vertex.bsdf, ctx, vertex.si, wo, active)
        guides = self._guides(vertex) & active
        power = self._chosen(vertex, mi.Float(0), guides)[1]
        guides &= power > 0
        (photons,) = self._densities(vertex, (wo,), power, guides)
        return value, dr.select(guides, _mixed(pdf, photons), pdf)

    def _guides(self, vertex: Vertex) -> mi.Bool:
        """Whether a final gather begins at the vertex."""
        return vertex.si.is_valid() & (vertex.path.history == BEFORE) & is_diffuse(vertex.bsdf)

    @dr.syntax
    def _chosen(
        self, vertex: Vertex, sample: mi.Float, active: mi.Bool
    ) -> tuple[mi.Vector3f, mi.Float]:
        """The direction of a photon, chosen in proportion to its power; and the power of all."""
        chosen, power, sample = mi.Vector3f(0, 0, 1), mi.Float(0), mi.Float(sample)
        state, searches = self._grid.begin(), mi.Bool(active)
        while dr.hint(searches, label="choose photon"):
            state, index, found, searches = self._grid.next(state, vertex.si.p, searches)
            d, weight = self._photon(vertex, self._vertices.at(index, found), found)
            power += weight
            # Each photon takes the place of those before it with the probability of its share
            share = dr.select(power > 0, weight / power, 0)
            takes = sample < share
            chosen = dr.select(takes, d, chosen)
            rest = dr.select(takes, sample, sample - share)
            sample = _below_one(rest / dr.maximum(dr.select(takes, share, 1 - share), 1e-12))
        return chosen, power

    @dr.syntax
    def _densities(
        self,
        vertex: Vertex,
        directions: tuple[mi.Vector3f, ...],
        power: mi.Float,
        active: mi.Bool,
    ) -> list[mi.Float]:
        """The densities with which photons choose these directions (local)."""
        sums = [mi.Float(0)] * len(directions)
        state, searches = self._grid.begin(), mi.Bool(active)
        while dr.hint(searches, label="density of photons"):
            state, index, found, searches = self._grid.next(state, vertex.si.p, searches)
            d, weight = self._photon(vertex, self._vertices.at(index, found), found)
            sums = _added(sums, weight, mi.Frame3f(d), directions)
        inverse = dr.select(power > 0, dr.rcp(power), 0)
        return _scaled(sums, inverse)

    def _photon(
        self, vertex: Vertex, other: LightVertex, active: mi.Bool
    ) -> tuple[mi.Vector3f, mi.Float]:
        """The direction from which a photon has come (local at ``vertex``), and its power, which is
        0 if it does not count."""
        d = vertex.si.to_local(other.si.to_world(other.si.wi))
        counts = active & (other.depth > 1) & (other.history.scattered != 0)
        counts &= d.z * vertex.si.wi.z > 0
        power = dr.max(mi.unpolarized_spectrum(other.β))
        return d, dr.select(counts & dr.isfinite(power), power, 0)


def _added(
    sums: list[mi.Float], weight: mi.Float, lobe: mi.Frame3f, directions: tuple[mi.Vector3f, ...]
) -> list[mi.Float]:
    """The sums, with the density of a photon's lobe in each of the directions."""
    density = mi.warp.square_to_von_mises_fisher_pdf
    return [
        total + weight * density(lobe.to_local(d), _CONCENTRATION)
        for total, d in zip(sums, directions)
    ]


def _scaled(values: list[mi.Float], factor: mi.Float) -> list[mi.Float]:
    return [value * factor for value in values]


def _mixed(pdf: mi.Float, photons: mi.Float) -> mi.Float:
    return (1 - _SHARE) * pdf + _SHARE * photons


def _below_one(sample: mi.Float) -> mi.Float:
    return dr.clip(sample, 0, 1 - 2**-24)
