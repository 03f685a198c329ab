"""How much memory the paths of a pass take, in bytes.

These are the sizes of arrays, for vertices of the largest size: with whole interactions, and with
the sums of a trial. Dr.Jit rounds the sizes up (``rendering/device.py``).
"""

from __future__ import annotations

import mitsuba as mi

from .bidirectional_programs import StoredSums
from .light_program import StoredHistory
from .light_vertices import Layout, bytes_per_vertex

#: Vertices of a light path that are stored at a time, at least. Most paths have fewer.
_VERTICES = 4

#: Bytes, about, of the state of a light path; of what is kept of it until the camera paths are
#: traced; and of a camera path.
_STATE, _KEPT, _CAMERA = 256, 256, 128


def bytes_of_light_path(history: StoredHistory, kept: bool = True) -> int:
    """
    Parameters:
        history: How its history is stored.
        kept: Whether its vertices are kept, without gaps, until camera paths are traced.
    """
    layout = Layout(len(mi.Spectrum()), history, True)
    return _VERTICES * bytes_per_vertex(layout) + _STATE + (_KEPT if kept else 0)


def bytes_of_both_paths(light_paths: float) -> float:
    """A camera path, and ``light_paths`` light paths that are connected to it or merged with it."""
    return light_paths * bytes_of_light_path(StoredSums(5)) + _CAMERA


def bytes_of_photons(light_paths: float) -> float:
    """A camera path, and ``light_paths`` light paths whose vertices are photons."""
    return max(1.0, light_paths) * bytes_of_light_path(StoredHistory())
