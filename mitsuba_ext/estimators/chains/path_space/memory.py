"""Storage of light paths, vertex by vertex, in the local memory of each lane."""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi


@dataclass
class Place:
    """A vertex of a path.

    Attributes:
        p: The point; for a light at infinity, the direction towards it.
        lobe: The random number, in [0, 1), that chooses the lobe of the BSDF. It matters only for
            delta lobes.
        is_discrete: Whether a delta lobe scatters the path (a mirror, smooth glass, or a hole of a
            mask): 0 or 1.
        d: The direction of the ray from here to the next vertex, on the way from the camera. It is
            stored because rays start at an offset from the surface: for vertices that are close
            together, it does not follow from their positions.
    """

    p: mi.Point3f
    lobe: mi.Float
    is_discrete: mi.UInt32
    d: mi.Vector3f


@dataclass
class Logs:
    """Natural logarithms of densities at a vertex; −∞ for 0.

    The density of a vertex per area (for a light at infinity: per solid angle) is the density of a
    direction at its neighbour times a geometric factor. If a delta lobe chose the direction, its
    density counts as 1, and the geometric factor is such that both ways through the lobe agree.

    Attributes:
        from_camera, from_light: The geometric factors, for the neighbours on either side. At the
            first vertex, ``from_camera`` is the density of a uniform position on the film; at the
            last vertex, ``from_light`` is the density with which light paths begin there.
        to_light, to_camera: The densities per solid angle of the directions to the neighbours. At
            the last vertex, ``to_camera`` is the factor that emission contributes to the previous
            vertex's density.
    """

    from_camera: mi.Float
    from_light: mi.Float
    to_light: mi.Float
    to_camera: mi.Float


@dataclass
class PathMemory:
    """Memory for two paths in each lane, the state of a chain and its proposal. The vertices of a
    path are numbered from 1, at the camera, and lie at consecutive places starting at ``at``.

    Attributes:
        places, logs: The vertices.
    """

    places: dr.Local
    logs: dr.Local

    @classmethod
    def of(cls, most: int) -> PathMemory:
        """Memory for paths of at most ``most`` vertices."""
        size = 2 * stride(most)
        return cls(
            dr.alloc_local(Place, size, value=dr.zeros(Place)),
            dr.alloc_local(Logs, size, value=dr.zeros(Logs)),
        )


def stride(most: int) -> int:
    """The distance between the two paths in memory, for paths of at most ``most`` vertices. Some
    places before the first vertex and after the last one are also read, without effect."""
    return most + 3


@dataclass
class Head:
    """The data of a path except its vertices.

    Attributes:
        at: The place where its vertices begin in the memory of the lane.
        length: The number of segments, which is the number of vertices without the camera.
        film: The position on the film, in [0, 1)² over the crop window.
        aperture, time, wavelength: The other random numbers of the camera ray.
        emitter: The index of its light in ``scene.emitters()``.
    """

    at: mi.UInt32
    length: mi.UInt32
    film: mi.Point2f
    aperture: mi.Point2f
    time: mi.Float
    wavelength: mi.Float
    emitter: mi.UInt32


def log(x: mi.Float) -> mi.Float:
    """The logarithm of ``x``; −∞ for zero and negative numbers."""
    return dr.select(x > 0, dr.log(dr.maximum(x, 1e-38)), -dr.inf)
