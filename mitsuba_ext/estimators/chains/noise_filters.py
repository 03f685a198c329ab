"""Filters that make the noise of chains more even, at the cost of bias."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
from scipy.ndimage import uniform_filter

from .chain_image import ChainImage
from .looped import LoopedChains
from .target import Contribution


@dataclass(frozen=True)
class NoiseFilters:
    """The noise filters in use.

    Source: D. Cline, PhD thesis, 2007, section 8.4.4.

    Attributes:
        width: The width in pixels of the box that smooths the number of proposals; 0 for no such
            filter.
        most_consecutive: The maximum number of a chain's consecutive visits to a pixel to add; 0
            for no limit.
    """

    width: int = 0
    most_consecutive: int = 0

    def __bool__(self) -> bool:
        return self.width > 0 or self.most_consecutive > 0


class FilteredImage(ChainImage):
    """Multiplies the chains' contribution to a pixel by the expected number of proposals there, and
    divides it by the actual number. The expected number is the mean over the neighbourhood.

    Parameters:
        width: The width of the neighbourhood, in pixels.
    """

    def __init__(self, film: mi.Film, width: int) -> None:
        super().__init__(film)
        self._film, self._width = film, width
        border = self._visits.border_size() > 0
        # Uses the film's reconstruction filter, so that a proposal and a visit have the same weight
        # in a pixel
        self._proposals = mi.ImageBlock(
            film.crop_size(), film.crop_offset(), 1, film.rfilter(), border, coalesce=False
        )
        self._blocks.append(self._proposals)

    def propose(self, found: Contribution) -> None:
        """Counts proposals, including black ones."""
        self._proposals.put(found.position, [mi.Float(1)])

    def _filtered(self, visits):
        if self._width == 0:
            return visits
        made = np.maximum(np.array(self._proposals.tensor())[..., 0], 0)
        inside = uniform_filter(np.ones_like(made), self._width, mode="constant")
        expected = uniform_filter(made, self._width, mode="constant") / inside
        # Pixels without proposals are not scaled: only the first states of chains contribute there.
        # Negative lobes of the reconstruction filter can make the number of proposals tiny
        ratio = np.where(made > 0, expected / np.maximum(made, 1e-30), 1)
        ratio = np.minimum(ratio, self._width**2)
        return visits * mi.TensorXf(ratio[..., None].astype(np.float32))


class FilteredChains(LoopedChains):
    """Chains that count their proposals and limit the consecutive visits to a pixel that they add.

    Parameters:
        filters: The noise filters in use.
    """

    def __init__(self, filters: NoiseFilters, *chains: Any) -> None:
        self._most = dr.opaque(mi.Float, filters.most_consecutive or dr.largest(mi.Float))
        super().__init__(*chains)

    def kernel_state(self):
        return super().kernel_state(), self._most

    def _added(self, state, proposal, is_accepted, weight, a, earlier):
        self._image.propose(proposal)
        visits = dr.select(is_accepted, weight, a)
        is_same = dr.all(dr.floor(state.position) == dr.floor(proposal.position))
        # The visits of the state precede the visits of a rejected proposal, but are added later
        room = dr.maximum(self._most - earlier - dr.select(is_accepted, 0, weight), 0)
        added = dr.select(is_accepted | is_same, dr.minimum(visits, room), visits)
        remembered = dr.select(is_same, earlier + added, 0)
        return added, dr.select(is_accepted | is_same, remembered, earlier)

    def _last(self):
        return dr.minimum(self._weight, dr.maximum(self._most - self._earlier, 0))
