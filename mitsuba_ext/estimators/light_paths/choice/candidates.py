"""The techniques of bidirectional path tracing that a render may use, and how often."""

from __future__ import annotations

from dataclasses import dataclass
from fractions import Fraction

from ..merging.merging_radius import MergingRadii

#: The numbers of light paths, for each camera path, that pilots choose from. Merging needs many:
#: the fewer there are, the wider is the radius in which a disk holds enough vertices. But four were
#: never better than one (efficiency 0.4 to 1.0 in mirrored_lamp, water-caustic, caustic, pool),
#: although 1.2 to 1.5 was predicted.
_COUNTS, _MERGING_COUNTS = (1 / 16, 1 / 4, 1.0, 4.0), (1.0,)

#: The numbers of connections. More than one were not measured beside merging, or beside four light
#: paths, and are not tried there.
_CONNECTIONS = (1, 0, 2, 4)

#: The largest of all these numbers.
MOST_TRIED = max(*_COUNTS, *_MERGING_COUNTS, *_CONNECTIONS)


@dataclass(frozen=True)
class Candidate:
    """A set of techniques.

    Attributes:
        light_paths: Number of light paths for each camera path. With 0, the candidate has only the
            techniques of ``path``.
        connections: Number of connections of each vertex of a camera path to vertices of light
            paths (s, t ≥ 2), in units of the number that the integrator has by default.
        merges: Whether camera paths are merged with light paths.
        alone: Whether nothing else finds light: photons (:class:`PhotonMapper`).
    """

    light_paths: float
    connections: int = 1
    merges: bool = False
    alone: bool = False

    def __str__(self) -> str:
        if self.alone:
            return "photons"
        parts = [f"{Fraction(self.light_paths).limit_denominator(64)} for each camera path"]
        if self.connections != 1:
            parts.append(f"{self.connections or 'no'} connections")
        parts += ["merging"] if self.merges else []
        return ", ".join(parts)


@dataclass(frozen=True)
class Available:
    """What a render can use.

    Attributes:
        has_image: Whether light paths are connected to the sensor.
        connects: Whether light paths are connected to camera paths.
        radii: The radii within which vertices are merged; ``None`` if they are not.
        are_shared: Whether a camera path can be connected to any light path. If not, each camera
            path has its own light path.
        most_lanes: The largest number of camera paths in a pass, with one light path for each; 0
            for any number.
    """

    has_image: bool
    connects: bool
    radii: MergingRadii | None
    are_shared: bool
    most_lanes: int = 0

    @property
    def merges_in_media(self) -> bool:
        """Whether vertices in media are merged."""
        return self.radii is not None and self.radii.ball is not None

    def samples_per_vertex(self, spp: int, pixels: int) -> tuple[float, float]:
        """:meth:`MergingRadii.samples_per_vertex` in a render of ``spp`` samples per pixel, with
        as many light paths as candidates with merging have."""
        if self.radii is None:
            return 1.0, 1.0
        (light_paths,), passes = _MERGING_COUNTS, 1
        if self.most_lanes > 0:
            in_pass = max(1, int(self.most_lanes / max(1.0, light_paths)) // pixels)
            passes = -(-spp // in_pass)
        return self.radii.samples_per_vertex(light_paths, spp / passes, passes)


def candidates(available: Available) -> list[Candidate]:
    """The candidates of a render; the first one is ``path``, the second one has all techniques."""
    can_merge = available.radii is not None
    everything = Candidate(1.0, int(available.connects), can_merge)
    found = [Candidate(0.0), everything]
    for merges in (False, True) if can_merge else (False,):
        for count in _MERGING_COUNTS if merges else _COUNTS:
            for connections in _CONNECTIONS if available.connects else (0,):
                candidate = Candidate(count, connections, merges)
                # Light paths without any technique are of no use
                is_useful = connections or available.has_image or merges
                # Several vertices of one light path would depend on each other
                is_possible = available.are_shared or (count == 1 and connections <= 1)
                is_tried = connections <= 1 or (not merges and count <= 1)
                if is_useful and is_possible and is_tried and candidate != everything:
                    found.append(candidate)
    return found
