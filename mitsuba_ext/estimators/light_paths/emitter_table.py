"""The table of a scene's emitters: how light paths start from each."""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np

from ...util.arrays import from_numpy
from .light_pieces import LightPieces

#: Words of an emitter in the table.
_WORDS = 8


@dataclass
class EmitterRow:
    """The row of an emitter.

    Attributes:
        probability: Probability with which the emitter is chosen.
        density: Density of the position; see :class:`.EmittedRay`.
        kind, way, parameter, axis: See :class:`.LightPieces`.
        is_beam: Whether the emitter has only one direction.
    """

    probability: mi.Float
    density: mi.Float
    kind: mi.UInt32
    way: mi.Float
    is_beam: mi.Bool
    parameter: mi.Float
    axis: mi.Vector3f


class EmitterTable:
    """
    Parameters:
        pieces: The pieces of the emitters.
        density: For each emitter, the density of the position.
        is_delta_direction: Which emitters have only one direction.
        emitters: The emitters.
    """

    def __init__(
        self,
        pieces: LightPieces,
        density: np.ndarray,
        is_delta_direction: np.ndarray,
        emitters: mi.EmitterPtr,
    ) -> None:
        count = len(density)
        table = np.zeros((count, _WORDS), dtype=np.float32)
        table[:, 0], table[:, 1] = pieces.probability, density
        table[:, 2] = pieces.kind + 16 * pieces.way + 64 * is_delta_direction
        table[:, 3], table[:, 4:7] = pieces.parameter, pieces.axis
        self._words = from_numpy(mi.Float, table)
        ids = dr.reinterpret_array(mi.UInt32, emitters).numpy()
        index = np.zeros(ids.max() + 1, dtype=np.uint32)
        index[ids] = np.arange(count)
        self._index = from_numpy(mi.UInt32, index)

    def row(self, index: mi.UInt32, active: mi.Bool) -> EmitterRow:
        """The row of an emitter, by its number in ``scene.emitters()``."""
        words = dr.gather(mi.ArrayXf, self._words, index, active, shape=(_WORDS, dr.width(index)))
        mark = mi.UInt32(words[2])
        return EmitterRow(
            words[0], words[1], mark & 15, mi.Float((mark >> 4) & 3), (mark & 64) != 0, words[3],
            mi.Vector3f(words[4], words[5], words[6]),
        )  # fmt: skip

    def chance(self, index: mi.UInt32, active: mi.Bool) -> mi.Float:
        """The probability with which an emitter is chosen."""
        return dr.gather(mi.Float, self._words, index * _WORDS, active)

    def index(self, emitter: mi.EmitterPtr, active: mi.Bool) -> mi.UInt32:
        """The number of an emitter in ``scene.emitters()``."""
        id = dr.reinterpret_array(mi.UInt32, emitter)
        return dr.gather(mi.UInt32, self._index, id, active & (id < len(self._index)))
