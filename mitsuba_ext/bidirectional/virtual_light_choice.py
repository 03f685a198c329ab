"""Choosing virtual lights without looking at the vertex that they are to light."""

from __future__ import annotations

from typing import Protocol

import drjit as dr
import mitsuba as mi
import numpy as np

from ..arrays import from_numpy
from ..transport.bsdfs import eval_bsdf
from ..transport.frozen import frozen
from ..transport.path_decisions import SubpathSelection
from ..transport.vertex import Vertex
from .light_vertices import VertexCache
from .vertex_choice import Chosen
from .virtual_lights import VirtualLights

#: Slots for each virtual light, on average.
_SLOTS = 8


class VirtualLightChoice(Protocol):
    """Chooses a virtual light for each vertex of a camera path.

    Attributes:
        is_stratified: Are the first numbers of several connections to be evenly spread?
    """

    is_stratified: bool

    def numbers(self, sampler: mi.Sampler) -> tuple[mi.Point2f, ...]:
        """The random numbers that choose one."""

    def choose(
        self, numbers: tuple[mi.Point2f, ...], vertex: Vertex, active: mi.Bool
    ) -> Chosen:
        """The virtual light that the numbers choose."""


class UniformChoice:
    """All virtual lights of a set have the same probability.

    Parameters:
        lights: The virtual lights.
        set_index: The set of each lane.
        largest: The bound of the kernel.
    """

    is_stratified = True

    def __init__(self, lights: VirtualLights, set_index: mi.UInt32, largest: mi.Float) -> None:
        self._share = lights.share
        self._begin = dr.gather(mi.UInt32, lights.begin, set_index)
        self._number = dr.gather(mi.UInt32, lights.number, set_index)
        dr.eval(self._begin, self._number)

    def numbers(self, sampler):
        return (sampler.next_2d(),)

    def choose(self, numbers, vertex, active):
        number = mi.Float(self._number)
        index = dr.minimum(mi.UInt32(numbers[0].x * number), self._number - 1)
        return Chosen(self._begin + index, number * self._share, active & (self._number > 0))


class PowerChoice(UniformChoice):
    """The probability of a virtual light grows with the flux that it emits: each has one of eight
    slots for itself, and a part of the others in proportion to its flux. A random number chooses a
    slot, so that the probabilities are exact, and neighbouring numbers choose neighbours."""

    def __init__(self, lights: VirtualLights, set_index: mi.UInt32, largest: mi.Float) -> None:
        super().__init__(lights, set_index, largest)
        owner, number = _slots(lights)
        self._owner, self._slot_count = (
            from_numpy(mi.UInt32, values) for values in (owner, number)
        )

    def choose(self, numbers, vertex, active):
        slots, exists = self._number * _SLOTS, active & (self._number > 0)
        slot = dr.minimum(mi.UInt32(numbers[0].x * mi.Float(slots)), slots - 1)
        index = dr.gather(mi.UInt32, self._owner, self._begin * _SLOTS + slot, exists)
        own = dr.gather(mi.UInt32, self._slot_count, index, exists)
        factor = self._share * mi.Float(slots) / mi.Float(dr.maximum(own, 1))
        return Chosen(index, factor, exists)


class LearnedChoice:
    """The probability of a virtual light grows with its brightness, and with what pilots found
    such light to contribute from its region to that of the camera path's vertex, occlusion
    included. It is chosen among the virtual lights of all sets.

    Parameters:
        lights: The virtual lights.
        selection: What was learned.
    """

    is_stratified = True

    def __init__(self, lights: VirtualLights, selection: SubpathSelection) -> None:
        vertices = lights.vertices
        # Rounded up, so that passes share kernels
        index = dr.arange(mi.UInt32, vertices.room)
        active = index < dr.opaque(mi.UInt32, vertices.count)
        light = vertices.at(index, active)
        brightness = dr.mean(light.β)
        brightness = dr.select(active & dr.isfinite(brightness), brightness, 0)
        self._region = dr.select(active, light.sums.region, 0)
        dr.eval(brightness, self._region)
        self._among = selection.among(self._region, brightness)
        self._share = dr.opaque(mi.Float, 1 / len(vertices.first))

    def numbers(self, sampler):
        return (sampler.next_2d(),)

    def choose(self, numbers, vertex, active):
        index, probability = self._among(numbers[0], vertex.path.sums.region, active)
        exists = active & (probability > 0)
        factor = self._share / dr.select(exists, probability, 1)
        region = dr.gather(mi.UInt32, self._region, index, exists)
        return Chosen(index, factor, exists, region=region, probability=probability)


def emitted_flux(lights: VirtualLights) -> np.ndarray:
    """Estimates the flux that each virtual light emits: what it receives, times the albedo that its
    BSDF would have if it scattered in all directions what it scatters along the normal."""
    vertices = lights.vertices
    # Rounded up, so that passes share a recording
    index = dr.arange(mi.UInt32, vertices.room)
    active = index < dr.opaque(mi.UInt32, vertices.count)
    dr.eval(index, active)
    return _flux(lights.scene, vertices, index, active).numpy()[: vertices.count].astype(np.float64)


@frozen
def _flux(
    scene: mi.Scene, vertices: VertexCache, index: mi.UInt32, active: mi.Bool
) -> mi.Float:
    # ``scene`` holds the BSDFs that are called
    vertex = vertices.at(index, active)
    si = vertex.si
    along_normal = mi.Vector3f(0, 0, dr.select(si.wi.z < 0, mi.Float(-1), 1))
    cosine = dr.maximum(dr.abs(si.wi.z), 1e-3)
    to_camera = mi.SurfaceInteraction3f(si)
    to_camera.wi = along_normal
    value, _pdf = eval_bsdf(si.bsdf(), mi.BSDFContext(), to_camera, si.wi, active)
    # Glossy surfaces scatter little along the normal: none is to be left out
    albedo = dr.clip(dr.pi * dr.max(value) / cosine, 0.05, 1)
    flux = dr.sum(dr.abs(vertex.β)) * albedo
    return dr.select(active & dr.isfinite(flux), flux, 0)


def _slots(lights: VirtualLights) -> tuple[np.ndarray, np.ndarray]:
    """The virtual light that owns each slot, and the number of slots of each virtual light. Both
    have room for more, so that passes share a recording."""
    flux = emitted_flux(lights)
    count = np.empty(len(flux), np.uint32)
    for begin, number in zip(lights.begin.numpy(), lights.number.numpy()):
        part = flux[begin : begin + number]
        total = part.sum()
        share = part / total if total > 0 else np.full(number, 1 / max(number, 1))
        # Rounded such that all numbers add up
        edges = np.rint(np.cumsum(share) * (_SLOTS - 1) * number)
        if number:
            edges[-1] = (_SLOTS - 1) * number
        count[begin : begin + number] = 1 + np.diff(edges, prepend=0)
    owner = np.repeat(np.arange(len(flux), dtype=np.uint32), count)
    unused = lights.vertices.room - len(count)
    return np.pad(owner, (0, _SLOTS * unused)), np.pad(count, (0, unused))
