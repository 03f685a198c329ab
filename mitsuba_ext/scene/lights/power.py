"""The power of emitters."""

from __future__ import annotations

import functools
import math

import drjit as dr
import mitsuba as mi
import numpy as np

from ...util.arrays import from_numpy
from ...util.spectra import brightness
from ..bounds import scene_bounds
from ..movers import is_moving_light
from .division import emitter_shapes

#: The number of samples of each emitter.
_SAMPLES = 256

#: The maximum number of texels evaluated of a spot's texture (a larger one is subsampled), and the
#: number of points along each edge of a texture that is not a bitmap.
_MAX_TEXELS, _POINTS = 1 << 22, 256


def emitter_powers(scene: mi.Scene) -> np.ndarray:
    """Estimates the power of each emitter, in units of brightness: the power that it emits or, for
    an emitter at infinity, the power that enters the bounding sphere of the scene. An estimate can
    be 0 although the emitter emits.

    Returns:
        Shape [emitters].
    """
    emitters = scene.emitters()
    is_infinite = np.array([mi.has_flag(e.flags(), mi.EmitterFlags.Infinite) for e in emitters])
    powers = np.zeros(len(emitters))
    powers[~is_infinite] = _sent_out(scene, np.flatnonzero(~is_infinite))
    powers[is_infinite] = _sent_in(scene, np.flatnonzero(is_infinite))
    for index, emitter in enumerate(emitters):
        size = _texture_size(emitter)
        if size is not None:
            powers[index] = _spot_power(emitter, *size)
    return powers


def _sent_out(scene: mi.Scene, indices: np.ndarray) -> np.ndarray:
    if len(indices) == 0:
        return np.zeros(0)
    # The power of a moving light is computed at rest
    at_rest = [e.nested if is_moving_light(e) else e for e in scene.emitters()]
    shapes = [
        e.nested.get_shape() if is_moving_light(e) else shape
        for e, shape in zip(scene.emitters(), emitter_shapes(scene))
    ]
    # Not by a call through a pointer: Dr.Jit would trace all emitters in memory, even of
    # other scenes
    senders = [functools.partial(_radiated, at_rest[i], shapes[i]) for i in indices]
    index, sampler = _lanes(len(indices))
    numbers = sampler.next_1d(), sampler.next_2d(), sampler.next_2d()
    return _means(dr.switch(index, senders, *numbers), len(indices))


def _radiated(
    emitter: mi.Emitter, shape: mi.Shape | None, x: mi.Float, y: mi.Point2f, z: mi.Point2f
) -> mi.Float:
    """A sample of an emitter's power, from uniform numbers."""
    try:
        weight = emitter.sample_ray(0.0, x, y, z)[1]
    except RuntimeError:  # its texture cannot sample wavelengths (a checkerboard, an attribute)
        if shape is None:
            return dr.zeros(mi.Float, dr.width(x))
        ps = shape.sample_position(0.0, y)
        wavelengths, weight = _wavelengths(x)
        si = mi.SurfaceInteraction3f(ps, wavelengths)
        si.wi = mi.Vector3f(0, 0, 1)
        weight *= emitter.eval(si) * dr.select(ps.pdf > 0, dr.pi / ps.pdf, 0)
    return brightness(weight)


def _sent_in(scene: mi.Scene, indices: np.ndarray) -> np.ndarray:
    """The power that emitters at infinity send into the bounding sphere. Their directions are
    sampled, not their rays, because Mitsuba starts such rays on a disk of the scene's size, which
    is wrong where rectangles were merged (``bounds.py``)."""
    if len(indices) == 0:
        return np.zeros(0)
    bbox = scene_bounds(scene)
    sphere = bbox.bounding_sphere() if bbox.valid() else mi.ScalarBoundingSphere3f(0.0, 1.0)
    index, sampler = _lanes(len(indices))
    emitter = dr.gather(mi.UInt32, from_numpy(mi.UInt32, indices), index)
    emitter = dr.gather(mi.EmitterPtr, scene.emitters_dr(), emitter)
    ref = dr.zeros(mi.Interaction3f, dr.width(index))
    ref.p = mi.Point3f(sphere.center)
    ref.wavelengths, weight = _wavelengths(sampler.next_1d())
    weight *= emitter.sample_direction(ref, sampler.next_2d(), mi.Bool(True))[1]
    return math.pi * sphere.radius**2 * _means(brightness(weight), len(indices))


def _lanes(count: int) -> tuple[mi.UInt32, mi.Sampler]:
    """For the samples of ``count`` emitters: the emitter of each lane, and a sampler."""
    lanes = count * _SAMPLES
    sampler = mi.load_dict({"type": "independent"})
    sampler.seed(0, lanes)
    return dr.arange(mi.UInt32, lanes) // _SAMPLES, sampler


def _wavelengths(sample: mi.Float) -> tuple[mi.Spectrum, mi.Spectrum]:
    """Wavelengths, as Mitsuba's emitters choose them, and 1 / their density."""
    if not mi.is_spectral:
        return dr.zeros(mi.Interaction3f).wavelengths, mi.Spectrum(1)
    return mi.sample_rgb_spectrum(mi.sample_shifted(sample))


def _means(value: mi.Float, count: int) -> np.ndarray:
    # If an emitter's value is constant, Mitsuba returns an array of one value
    value = mi.Float64(value + dr.zeros(mi.Float, count * _SAMPLES))
    return dr.block_sum(dr.select(dr.isfinite(value), value, 0), _SAMPLES).numpy() / _SAMPLES


def _texture_size(emitter: mi.Emitter) -> tuple[int, int] | None:
    """Width and height of the texture of a spot; ``None`` for all other emitters, and for spots
    without a texture. (Mitsuba ignores the texture when it samples rays of a spot.)"""
    is_textured = mi.has_flag(emitter.flags(), mi.EmitterFlags.SpatiallyVarying)
    if emitter.class_name() != "SpotLight" or not is_textured:
        return None
    parameters = mi.traverse(emitter)
    if "texture.data" not in parameters:
        return _POINTS, _POINTS
    height, width = parameters["texture.data"].shape[:2]
    step = max(1, math.ceil(math.sqrt(height * width / _MAX_TEXELS)))
    return math.ceil(width / step), math.ceil(height / step)


def _spot_power(emitter: mi.Emitter, width: int, height: int) -> float:
    """The power of a spot: a sum over texels, which divide a square in the plane at distance 1."""
    angle = float(dr.slice(mi.traverse(emitter)["cutoff_angle"]))
    edge = 2 * math.tan(math.radians(angle))
    index = dr.arange(mi.UInt32, width * height)
    row = index // width
    p = mi.Point3f(
        edge * ((mi.Float(index - row * width) + 0.5) / width - 0.5),
        edge * ((mi.Float(row) + 0.5) / height - 0.5),
        1,
    )
    ref = dr.zeros(mi.Interaction3f, width * height)
    ref.p = mi.Transform4f(emitter.world_transform()) @ p
    ref.wavelengths, weight = _wavelengths(mi.sample_tea_float32(index, 0))
    ds, radiance = emitter.sample_direction(ref, mi.Point2f(0.5), mi.Bool(True))
    # Intensity times the solid angle of a texel, dA cos θ / r², with cos θ = 1 / r
    r_2 = dr.squared_norm(mi.Vector3f(p))
    value = mi.Float64(brightness(weight * radiance) * dr.square(ds.dist) * r_2**-1.5)
    value = dr.select(dr.isfinite(value), value, 0)
    return float(dr.sum(value)[0]) * edge**2 / (width * height)
