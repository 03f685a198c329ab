"""Media whose extinction varies between colours (or wavelengths).

``volpath`` lets one colour choose all distances of a path, and divides by the density of that
colour. The throughput of the other colours then has no bound. Here, each flight chooses a colour
anew, with a probability proportional to the throughput of the colour, and is divided by the density
with which all colours together sample its distance, p(t) = Σ P_c p_c(t). Null collisions are chosen
in the same way. The throughput thus remembers how likely each colour made the path so far: where no
colour is absorbed more than another, P_c is the probability that colour c has chosen the path, and
p is the density of all its vertices under spectral MIS, as in ``volpathmis``. The sum of the
throughput over colours never grows in a medium, grids included.

Sources: B. Miller, I. Georgiev, W. Jarosz, *A Null-Scattering Path Integral Formulation of Light
Transport*, ACM Transactions on Graphics 38(4), 2019, section 5.1 (spectral MIS); P. Kutz, R. Habel,
Y. K. Li, J. Novák, *Spectral and Decomposition Tracking for Rendering Heterogeneous Volumes*, ACM
Transactions on Graphics 36(4), 2017, section 4 (probabilities that depend on the throughput); M.
Chiang, P. Kutz, B. Burley, *Practical and Controllable Subsurface Scattering for Production Path
Tracing*, SIGGRAPH 2016 Talks (choice of the colour).
"""

from __future__ import annotations

from dataclasses import replace

import drjit as dr
import mitsuba as mi

from ..scene.media import may_have_grids, may_have_media
from .free_flight import Distances, attenuation, shared_mean
from .media import Media
from .no_media import NoMedia


class ChromaticMedia(Media):
    """Like :class:`Media`, in a scene with chromatic media. The state has ``shares``, the
    probabilities of the colours."""

    def begin(self, sampler, rays):
        return replace(super().begin(sampler, rays), shares=_shares(mi.Spectrum(1)))

    def launch(self, inside, β, sampler, rays, ray, active):
        flies = active & (inside.medium != None)  # noqa: E711
        shares = dr.select(flies, _shares(β), inside.shares)
        chosen = _chosen(shares, sampler.next_1d(flies))
        inside = replace(inside, channel=dr.select(flies, chosen, inside.channel), shares=shares)
        return super().launch(inside, β, sampler, rays, ray, active)

    def _rate(self, σ, inside):
        return chosen_rate(σ, inside.channel)

    def _flown(self, σ, σ_s, t, scatters, inside):
        T = attenuation(σ, t)
        if not self._distances.scatter:
            return T
        # Above 2**−24 for the colour that has chosen the distance
        density = shared_mean(T * dr.select(scatters, σ, 1), inside.shares)
        return T * dr.select(scatters, σ_s, 1) * dr.select(density > 0, dr.rcp(density), 0)


def media_of(
    scene: mi.Scene,
    hide_emitters: bool,
    distances: Distances,
    is_chromatic: bool,
    connects_all: bool = False,
) -> NoMedia:
    """The object that handles the media of ``scene``. ``is_chromatic`` tells whether their
    extinction may vary between colours; see :class:`Media` for the other parameters."""
    if not may_have_media(scene):
        return NoMedia(hide_emitters)
    kind = ChromaticMedia if is_chromatic else Media
    return kind(hide_emitters, distances, may_have_grids(scene), connects_all)


def chosen_rate(σ: mi.UnpolarizedSpectrum, channel: mi.UInt32) -> mi.Float:
    """The colour (or wavelength) ``channel`` of an extinction."""
    rate = σ[0]
    for index in range(1, len(σ)):
        rate = dr.select(channel == index, σ[index], rate)
    return rate


def _shares(β: mi.Spectrum) -> mi.UnpolarizedSpectrum:
    """The probabilities with which colours choose a distance, behind a throughput of ``β``."""
    carried = dr.abs(mi.unpolarized_spectrum(β))
    total = dr.sum(carried)
    # The largest throughput may overflow, and dark paths have none
    usable = (total > 0) & dr.isfinite(total)
    return dr.select(usable, carried / total, 1 / len(carried))


def _chosen(shares: mi.UnpolarizedSpectrum, sample: mi.Float) -> mi.UInt32:
    """The colour that a uniform number chooses."""
    channel, below = mi.UInt32(0), mi.Float(0)
    for index in range(len(shares) - 1):
        below += shares[index]
        channel += dr.select(sample < below, mi.UInt32(0), 1)
    return channel
