"""What renders of this process have learned, for later renders of the same scene: frames of an
animation, cells of a notebook."""

from __future__ import annotations

import threading
from collections import OrderedDict
from collections.abc import Mapping
from typing import NamedTuple

import mitsuba as mi
import numpy as np

from ..scene.fingerprint import fingerprint
from ..util.stored_arrays import StoredArrays

#: The most renders of which this is kept.
_MOST = 4


class Kept(NamedTuple):
    """What one render has learned.

    Attributes:
        states: For each slot, the result of ``Learner.state``.
        pilot_spp: Samples per pixel of its pilots.
    """

    states: Mapping[str, Mapping[str, np.ndarray]]
    pilot_spp: int

    def arrays(self) -> dict[str, StoredArrays]:
        """The states, as a file has them."""
        return {slot: StoredArrays.of(state) for slot, state in self.states.items()}


_kept: OrderedDict[tuple[str, str], Kept] = OrderedDict()
_lock = threading.Lock()


def put(
    scene: mi.Scene, made_by: str, pilot_spp: int, states: Mapping[str, Mapping[str, np.ndarray]]
) -> None:
    """Keeps what was learned for ``scene``, in the place of the oldest.

    Parameters:
        made_by: The plugin, the parameters of the decisions that learned, and the size of the film.
    """
    with _lock:
        _kept[fingerprint(scene), made_by] = Kept(states, pilot_spp)
        while len(_kept) > _MOST:
            _kept.popitem(last=False)


def find(scene: mi.Scene, made_by: str) -> Kept | None:
    """What was kept for a scene with the same shapes, materials and lights."""
    with _lock:
        return _kept.get((fingerprint(scene), made_by))


def forget() -> None:
    """Keeps nothing any more."""
    with _lock:
        _kept.clear()
