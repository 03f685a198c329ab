"""How much memory the paths of a pass take, in bytes.

These are the sizes of arrays, for vertices of the largest size: with whole interactions, and with
the sums of a trial. Dr.Jit rounds the sizes up (``rendering/device.py``).
"""

from __future__ import annotations

import mitsuba as mi

from ...rendering.device import SampleBytes
from .bidirectional_programs import StoredSums
from .light_program import StoredHistory
from .light_vertices import Layout, bytes_per_vertex

#: Vertices of a light path that are stored at a time, at least. Most paths have fewer.
_STORED = 4

#: The largest mean number of vertices of light paths, about, in scenes where they are long.
_LONGEST = 32

#: Bytes, about, of the state of a light path; of its vertices without gaps; and of a camera path.
_STATE, _KEPT, _CAMERA = 256, 256, 128


def bytes_of_both_paths(light_paths: float, max_depth: int) -> SampleBytes:
    """A camera path, and ``light_paths`` light paths that are connected to it or merged with it."""
    found = _light_path(StoredSums(5), max_depth)
    return SampleBytes(light_paths * found.usual + _CAMERA, light_paths * found.largest)


def bytes_of_photons(light_paths: float, max_depth: int) -> SampleBytes:
    """A camera path, and ``light_paths`` light paths whose vertices are photons."""
    found, count = _light_path(StoredHistory(), max_depth), max(1.0, light_paths)
    return SampleBytes(count * found.usual, count * found.largest)


def bytes_of_connected_path() -> SampleBytes:
    """A light path whose vertices are connected to the sensor, round by round."""
    return SampleBytes(_STORED * _vertex(StoredHistory()) + _STATE + _KEPT)


def _light_path(history: StoredHistory, max_depth: int) -> SampleBytes:
    """A light path with this history, whose vertices are kept."""
    vertex = _vertex(history)
    most = min(_LONGEST, max(1, max_depth - 1))
    return SampleBytes(_STORED * vertex + _STATE + _KEPT, most * vertex)


def _vertex(history: StoredHistory) -> int:
    return bytes_per_vertex(Layout(len(mi.Spectrum()), history, True))
