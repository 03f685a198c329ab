"""Depth maps of a scene, seen from pieces of the aperture of a thin lens."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi

from ...scene.movers import sensor_at_rest
from ...transport.lens_view import LensView
from ...transport.numbers import hashed
from ...transport.path_decisions import SceneQuery

#: The random number, in x and y, that chooses the middle of the aperture.
_MIDDLE = 0.5


class DepthMaps:
    """A map for each piece of the aperture: the inverse depth of the surfaces seen through it. The
    pieces have equal areas: each is a square in the space of the random numbers that choose points
    of the aperture.

    A pixel has one ray, from a random point of the piece through a random point of the pixel, at a
    random time. A map takes 4 bytes for each pixel. All points are in the frame in which the sensor
    rests.

    The *place* of a point is its position on the film, seen through the middle of the aperture (x
    and y, in units of the film's size), and its inverse depth (z).

    Parameters:
        scene: The scene.
        sensor: A ``thinlens``, which may move.
        query: Intersects rays with the scene.
        pieces: The aperture has ``pieces``² pieces.
        most_pixels: Largest number of pixels of a map along its longer edge. A map never has more
            pixels than the film.

    Attributes:
        shape (tuple[int, int]): Width and height of a map.
        places (mi.Point3f): The places of all points that were seen, in any map.
        nearest, farthest (float): Inverse depths of the nearest and the farthest of these points.
        margins (tuple[float, float]): For points between these depths: the largest distance on the
            film, in x and y, between their positions seen through the middle and through the edge
            of the aperture.
        parallax (float): Between opposite points of the aperture, points at these two depths move
            on the film by different distances. This is the difference, in units of the film's
            longer edge.
    """

    def __init__(
        self, scene: mi.Scene, sensor: mi.Sensor, query: SceneQuery, pieces: int, most_pixels: int
    ) -> None:
        self._sensor, self.pieces = sensor_at_rest(sensor), pieces
        self._view = LensView(scene, sensor, query)
        size = [int(n) for n in sensor.film().crop_size()]
        shrink = min(1.0, most_pixels / max(size))
        self.shape = (max(1, round(size[0] * shrink)), max(1, round(size[1] * shrink)))
        self._maps = self._trace(sensor)
        self.nearest = self.farthest = self.parallax = 0.0
        self.margins = (0.0, 0.0)
        if dr.width(self.places) > 0:
            # Never equal: the table divides by their difference
            self.nearest = 1.001 * float(dr.slice(dr.max(self.places.z)))
            self.farthest = 0.999 * float(dr.slice(dr.min(self.places.z)))
            self._measure(size)

    def place(self, p: mi.Point3f) -> mi.Point3f:
        """The place of a point; 0 if the point is behind the lens."""
        return self._place(p, self._view.inverse_depth(p, mi.Bool(True)))

    def _place(self, p: mi.Point3f, inverse_depth: mi.Float) -> mi.Point3f:
        position = self._film_position(p, mi.Point2f(_MIDDLE))
        place = mi.Point3f(position.x, position.y, inverse_depth)
        return dr.select(inverse_depth > 0, place, 0)

    def _film_position(self, p: mi.Point3f, numbers: mi.Point2f) -> mi.Point2f:
        """The position on the film, in units of its size, at which a point is seen through a point
        of the aperture."""
        it = dr.zeros(mi.Interaction3f, dr.width(p))
        it.p = p
        ds, _ = self._sensor.sample_direction(it, numbers)
        return ds.uv / mi.ScalarVector2f(self._sensor.film().crop_size())

    def lens_numbers(self, piece: mi.UInt32, numbers: mi.Point2f) -> mi.Point2f:
        """The random numbers that choose a point of a piece: from relative coordinates in it,
        [0, 1)²."""
        corner = mi.Point2f(piece % self.pieces, piece // self.pieces)
        return (corner + numbers) / self.pieces

    def is_seen(
        self, place: mi.Point3f, numbers: mi.Point2f, piece: mi.UInt32, nearest: mi.Float
    ) -> mi.Bool:
        """Whether a point is seen through a point of the aperture, according to the piece's map.

        Parameters:
            place: The point's place.
            numbers: The random numbers that choose the point of the aperture.
            nearest: Surfaces with a larger inverse depth than this hide the point.
        """
        seen = self._seen_from(place, numbers)
        active = dr.all((seen >= 0) & (seen < 1))
        width, height = self.shape
        pixel = mi.Vector2u(dr.select(active, seen, 0) * mi.Vector2f(width, height))
        pixel = dr.minimum(pixel, mi.Vector2u(width - 1, height - 1))
        index = (piece * height + pixel.y) * width + pixel.x
        return active & (dr.gather(mi.Float, self._maps, index, active) <= nearest)

    def _seen_from(self, place: mi.Point3f, numbers: mi.Point2f) -> mi.Point2f:
        """The position on the film at which the point of a place is seen through a point of the
        aperture."""
        ray, _ = self._sensor.sample_ray(
            0, _MIDDLE, mi.Point2f(place.x, place.y), mi.Point2f(_MIDDLE)
        )
        distance = dr.rcp(place.z) - self._sensor.near_clip()
        p = ray.o + ray.d * (distance / dr.dot(ray.d, self._view.axis))
        return self._film_position(p, numbers)

    def _trace(self, sensor: mi.Sensor) -> mi.Float:
        """The maps, one after the other, row by row; 0 where nothing is seen."""
        width, height = self.shape
        lane = dr.arange(mi.UInt32, width * height * self.pieces**2)
        numbers = hashed(lane, 5)
        x, y, piece = lane % width, (lane // width) % height, lane // (width * height)
        position = mi.Point2f(x + numbers[0], y + numbers[1]) / mi.Vector2f(width, height)
        time = sensor.shutter_open() + numbers[4] * sensor.shutter_open_time()
        lens = self.lens_numbers(piece, mi.Point2f(numbers[2], numbers[3]))
        place = self._place(*self._view.meet(self._view.ray(position, lens, time)))
        dr.eval(place)
        self.places = dr.gather(mi.Point3f, place, dr.compress(place.z > 0))
        return place.z

    def _measure(self, size: list[int]) -> None:
        """Computes margins and parallax, for points seen in the middle of the film. Points seen
        elsewhere on the film move by the same distances."""
        place = mi.Point3f(_MIDDLE, _MIDDLE, mi.Float([self.farthest, self.nearest]))
        margins = []
        for i in range(2):
            edge = mi.Point2f(_MIDDLE)
            edge[i] = 1
            far, near = (float(x) - _MIDDLE for x in self._seen_from(place, edge)[i])
            margins.append(max(abs(far), abs(near)))
            self.parallax = max(self.parallax, 2 * abs(near - far) * size[i] / max(size))
        self.margins = (margins[0], margins[1])
