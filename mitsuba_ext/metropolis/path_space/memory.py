"""Light paths, vertex by vertex, in memory of the lane."""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi


@dataclass
class Place:
    """A vertex of a path.

    Attributes:
        p: The point; for a light at infinity, the direction towards it.
        lobe: The number, in [0, 1), that chooses the lobe of the BSDF, where the path is scattered
            by a discrete one.
        is_discrete: Is it scattered by a mirror, smooth glass, or a hole of a mask? 0 or 1.
        d: The direction of the ray from here to the next vertex, on the way from the camera. Rays
            begin at a small distance from a surface, so that two points that lie close to each
            other do not tell it.
    """

    p: mi.Point3f
    lobe: mi.Float
    is_discrete: mi.UInt32
    d: mi.Vector3f


@dataclass
class Logs:
    """Natural logarithms of densities at a vertex; −∞ for 0.

    A density of the vertex per area (of a light at infinity: per solid angle) is that of a
    direction at its neighbour, times a geometric factor. Where a discrete lobe chose the direction,
    the first counts as 1, and the second is such that both ways through the lobe agree.

    Attributes:
        from_camera, from_light: The geometric factors, for the neighbours on either side. At the
            first vertex, ``from_camera`` is the density of a uniform place on the film; at the
            last one, ``from_light`` is that with which light paths begin there.
        to_light, to_camera: The densities per solid angle of the directions in which the path goes
            on from here. At the last vertex, ``to_camera`` is what emission adds to the density of
            the vertex before it.
    """

    from_camera: mi.Float
    from_light: mi.Float
    to_light: mi.Float
    to_camera: mi.Float


@dataclass
class PathMemory:
    """Memory of two paths in each lane, the state of a chain and its proposal. The vertices of a
    path are numbered from 1, at the camera, and lie at consecutive places from ``at`` on.

    Attributes:
        places, logs: The vertices.
    """

    places: dr.Local
    logs: dr.Local

    @classmethod
    def of(cls, most: int) -> PathMemory:
        """For paths of at most so many vertices."""
        size = 2 * stride(most)
        return cls(
            dr.alloc_local(Place, size, value=dr.zeros(Place)),
            dr.alloc_local(Logs, size, value=dr.zeros(Logs)),
        )


def stride(most: int) -> int:
    """From one path in memory to the other, for paths of at most so many vertices. Some places are
    read, without effect, before the first vertex and after the last one."""
    return most + 3


@dataclass
class Head:
    """What a path is besides its vertices.

    Attributes:
        at: Where its vertices lie in the memory of the lane.
        length: Segments, and vertices without the camera.
        film: Where it meets the film: in [0, 1)² over the crop window.
        aperture, time, wavelength: The other numbers of the camera ray.
        emitter: The number of its light in ``scene.emitters()``.
    """

    at: mi.UInt32
    length: mi.UInt32
    film: mi.Point2f
    aperture: mi.Point2f
    time: mi.Float
    wavelength: mi.Float
    emitter: mi.UInt32


def log(x: mi.Float) -> mi.Float:
    """The logarithm, −∞ for 0 and what is below."""
    return dr.select(x > 0, dr.log(dr.maximum(x, 1e-38)), -dr.inf)
