"""Choosing virtual lights without looking at the vertex that they illuminate."""

from __future__ import annotations

from typing import Protocol

import drjit as dr
import mitsuba as mi
import numpy as np

from ....transport.bsdfs import eval_bsdf
from ....transport.frozen import frozen
from ....transport.path_decisions import SubpathSelection
from ....transport.vertex import Vertex
from ....util.arrays import from_numpy
from ..light_vertices import VertexCache
from ..vertex_choice import Chosen, below
from .virtual_lights import VirtualLights

#: Slots for each virtual light, on average.
_SLOTS = 8


class VirtualLightChoice(Protocol):
    """Chooses a virtual light for each vertex of a camera path.

    Attributes:
        is_stratified: Whether the first numbers of several connections should be evenly spread.
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
        number = lights.number.numpy()
        owner, count = _slots(emitted_flux(lights), number, lights.vertices.room)
        self._owner, self._slot_count = (from_numpy(mi.UInt32, x) for x in (owner, count))

    def choose(self, numbers, vertex, active):
        slots, exists = self._number * _SLOTS, active & (self._number > 0)
        slot = dr.minimum(mi.UInt32(numbers[0].x * mi.Float(slots)), slots - 1)
        index = dr.gather(mi.UInt32, self._owner, self._begin * _SLOTS + slot, exists)
        own = dr.gather(mi.UInt32, self._slot_count, index, exists)
        factor = self._share * mi.Float(slots) / mi.Float(dr.maximum(own, 1))
        return Chosen(index, factor, exists)


class LearnedChoice:
    """Chooses a region by the contribution of its light to the region of the camera path's vertex,
    as pilots have measured it with occlusion, and by the brightness of the virtual lights in it;
    then chooses one of these lights by flux. All sets of a pass are used as one.

    Parameters:
        lights: The virtual lights.
        selection: What was learned.
    """

    is_stratified = True

    def __init__(self, lights: VirtualLights, selection: SubpathSelection) -> None:
        vertices, count = lights.vertices, selection.count
        flux, brightness, region = _measured(lights)
        number = np.bincount(region, minlength=count)
        power = np.bincount(region, brightness, count).astype(np.float32)
        self._selection = selection.by_power(from_numpy(mi.Float, power))
        ranges = np.stack([np.cumsum(number) - number, number], axis=1).astype(np.uint32)
        # A stable sort, so that the order is the same in each render
        order = np.argsort(region.astype(np.uint16), kind="stable").astype(np.uint32)
        place, slots = _slots(flux[order], number, vertices.room)
        unused = np.zeros(vertices.room - len(order), np.uint32)
        words = ranges.ravel(), place, slots, np.append(order, unused)
        self._ranges, self._place, self._slot_count, self._order = (
            from_numpy(mi.UInt32, x) for x in words
        )
        self._share = dr.opaque(mi.Float, 1 / vertices.paths)

    def numbers(self, sampler):
        return sampler.next_2d(), sampler.next_2d()

    def choose(self, numbers, vertex, active):
        mine = vertex.path.history.region
        region, probability = self._selection.choose(numbers[0], mine, active)
        first, number = dr.gather(mi.Vector2u, self._ranges, region, active)
        exists = active & (number > 0) & (probability > 0)
        slot = below(number * _SLOTS, numbers[1])
        place = dr.gather(mi.UInt32, self._place, first * _SLOTS + slot, exists)
        own = dr.gather(mi.UInt32, self._slot_count, place, exists)
        factor = self._share * mi.Float(number * _SLOTS) / mi.Float(dr.maximum(own, 1))
        factor /= dr.select(exists, probability, 1)
        index = dr.gather(mi.UInt32, self._order, place, exists)
        return Chosen(index, factor, exists, region=region, probability=probability)


def _measured(lights: VirtualLights) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The flux that each virtual light emits (:func:`emitted_flux`); the brightness of what it
    receives; and its region, 0 where there are no regions."""
    vertices = lights.vertices
    found = (x.numpy()[: vertices.count] for x in _evaluated(lights.scene, vertices))
    flux, brightness, region = found
    return flux.astype(np.float64), brightness.astype(np.float64), region


def emitted_flux(lights: VirtualLights) -> np.ndarray:
    """Estimates the flux that each virtual light emits: what it receives, times the albedo that its
    BSDF would have if it scattered in all directions what it scatters along the normal."""
    return _measured(lights)[0]


@frozen
def _evaluated(
    scene: mi.Scene, vertices: VertexCache
) -> tuple[mi.Float, mi.Float, mi.UInt32]:
    # ``scene`` holds the BSDFs that are called
    index, active = vertices.every()
    vertex = vertices.at(index, active)
    si = vertex.si
    along_normal = mi.Vector3f(0, 0, dr.select(si.wi.z < 0, mi.Float(-1), 1))
    cosine = dr.maximum(dr.abs(si.wi.z), 1e-3)
    to_camera = mi.SurfaceInteraction3f(si)
    to_camera.wi = along_normal
    value, _pdf = eval_bsdf(si.bsdf(), mi.BSDFContext(), to_camera, si.wi, active)
    # Glossy surfaces scatter little along the normal, but none should be left out
    albedo = dr.clip(dr.pi * dr.max(value) / cosine, 0.05, 1)
    brightness = dr.sum(dr.abs(vertex.β))
    exists = active & dr.isfinite(brightness) & dr.isfinite(albedo)
    brightness = dr.select(exists, brightness, 0)
    region = mi.UInt32(0) if vertex.history is None else vertex.history.region
    return (
        brightness * dr.select(exists, albedo, 0), brightness,
        dr.select(active, region, mi.UInt32(0)),
    )  # fmt: skip


def _slots(flux: np.ndarray, number: np.ndarray, room: int) -> tuple[np.ndarray, np.ndarray]:
    """The virtual light that owns each slot, and the number of slots of each virtual light. Both
    have room for more, so that passes share a recording.

    Parameters:
        flux: The flux of each virtual light, group by group.
        number: The number of virtual lights in each group.
        room: The number of virtual lights for which the table has room.
    """
    count = np.empty(len(flux), np.uint32)
    begin = np.cumsum(number) - number
    for first, size in zip(begin, number):
        if size == 0:
            continue
        part = flux[first : first + size]
        total = part.sum()
        share = part / total if total > 0 else np.full(size, 1 / size)
        # Rounded so that all numbers add up
        edges = np.rint(np.cumsum(share) * (_SLOTS - 1) * size)
        edges[-1] = (_SLOTS - 1) * size
        count[first : first + size] = 1 + np.diff(edges, prepend=0)
    owner = np.repeat(np.arange(len(flux), dtype=np.uint32), count)
    unused = room - len(count)
    return np.pad(owner, (0, _SLOTS * unused)), np.pad(count, (0, unused))
