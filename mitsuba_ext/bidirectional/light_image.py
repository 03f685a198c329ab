"""The light image: stored vertices of light paths, connected to the sensor (t = 1)."""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi

from ..transport.estimator import Splats
from ..transport.heroes import Heroes
from ..transport.path_decisions import SceneQuery
from .light_vertices import LightVertices
from .partial_sums import PartialSums, weight
from .scattering import evaluate, geometric_cosine
from .sensor import ConnectableSensor, is_occluded


def light_image(
    scene: mi.Scene,
    sensor: ConnectableSensor,
    vertices: LightVertices,
    seed: mi.UInt32 | None = None,
    importance: Any = 1.0,
    sums: PartialSums | None = None,
    query: SceneQuery | None = None,
    hides_emitters: bool = False,
) -> tuple[Splats, mi.UInt32]:
    """Connects each of the ``vertices``, of which there is at least one, to the sensor: in a kernel
    of its own, which has a lane for each vertex.

    There must be as many light paths as camera paths. Then what a pixel's splats bring, divided by
    the number of its camera samples, is their share of the pixel's radiance.

    Parameters:
        seed: A random number of each light path; with the depth of the vertex it makes the numbers
            that choose a point of the aperture. ``None`` where the sensor needs none.
        importance: What the sensor makes of radiance, for each light path (``CameraRays``).
        sums: Computes MIS weights; without, all paths come from here.
        query: How a ray meets the scene.
        hides_emitters: Does the sensor look through area lights?

    Returns:
        The splats, and the shadow rays of each vertex.
    """
    query = query or SceneQuery()
    # Some lanes at least: very few would need other kernels
    index = dr.arange(mi.UInt32, max(16, vertices.count))
    active = index < dr.opaque(mi.UInt32, vertices.count)
    vertex = vertices.gather(index, active)
    si = vertices.interaction(query, vertex, active)
    sample = mi.Point2f(0.5)
    if seed is not None:
        word = dr.gather(mi.UInt32, seed, vertex.lane, active)
        sample = mi.Point2f(
            mi.sample_tea_float32(word, 2 * vertex.depth),
            mi.sample_tea_float32(word, 2 * vertex.depth + 1),
        )
    connection, lens_weight = sensor.connect(si, sample, active)
    active = active & connection.active
    if hides_emitters:
        active &= si.shape.emitter() == None  # noqa: E711
    to_camera = si.to_local(connection.d)
    heroes = Heroes(scene)
    value, reverse_pdf = evaluate(
        heroes, vertex.hero_is_alone, si.bsdf(), si, to_camera, active
    )
    value *= vertex.β * (connection.importance * lens_weight)
    if sums is not None:
        # The density with which a camera ray finds the vertex, per area
        found = connection.importance * geometric_cosine(si, to_camera)
        value *= weight(sums.others(found, vertex.sums, reverse_pdf))
    # A connection that cannot contribute needs no shadow ray
    active &= dr.max(dr.abs(value)) > 0
    tested = mi.UInt32(dr.select(active, 1, 0))
    active &= ~is_occluded(query, scene, si, connection, active, hides_emitters)
    if not isinstance(importance, float):
        is_single = dr.width(importance) == 1
        if not is_single:
            importance = dr.gather(type(importance), importance, vertex.lane, active)
        value *= importance
    finite = active & dr.all(dr.isfinite(value))
    return Splats(
        value, connection.position, vertices.wavelengths(vertex, active), finite
    ), tested
