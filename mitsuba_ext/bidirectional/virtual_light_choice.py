"""Choosing virtual lights without looking at the vertex that they are to light."""

from __future__ import annotations

from typing import Protocol

import drjit as dr
import mitsuba as mi
import numpy as np

from ..arrays import from_numpy
from ..transport.bsdfs import eval_bsdf
from ..transport.vertex import Vertex
from .vertex_choice import Chosen
from .virtual_lights import VirtualLights

#: Share of the choices that are uniform.
_DEFENSIVE = 0.1

#: Probabilities are multiples of this number, as random numbers are.
_GRAIN = 2.0**-24


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
    """The probability of a virtual light is proportional to the flux that it emits; a tenth of the
    choices is uniform."""

    def __init__(self, lights: VirtualLights, set_index: mi.UInt32, largest: mi.Float) -> None:
        super().__init__(lights, set_index, largest)
        self._sums = from_numpy(mi.Float, _running_sums(lights))
        self._steps = max(1, int(np.max(lights.number.numpy())).bit_length())

    @dr.syntax
    def choose(self, numbers, vertex, active):
        low, high = mi.UInt32(0), mi.UInt32(self._number)
        exists = active & (self._number > 0)
        x, step = numbers[0].x, mi.UInt32(0)
        # The first one whose running sum exceeds the random number
        while step < self._steps:
            middle = (low + high) >> 1
            below = dr.gather(
                mi.Float, self._sums, self._begin + middle, exists & (low < high)
            ) <= x
            searching = low < high
            low = dr.select(searching & below, middle + 1, low)
            high = dr.select(searching & ~below, middle, high)
            step += 1
        index = self._begin + dr.minimum(low, dr.maximum(self._number, 1) - 1)
        end = dr.gather(mi.Float, self._sums, index, exists)
        before = dr.gather(mi.Float, self._sums, index - 1, exists & (low > 0))
        probability = end - before
        exists &= probability > 0
        return Chosen(index, self._share / dr.select(exists, probability, 1), exists)


def emitted_flux(lights: VirtualLights) -> mi.Float:
    """Estimates the flux that each virtual light emits: what it receives, times the albedo that its
    BSDF would have if it scattered in all directions what it scatters along the normal."""
    vertices = lights.vertices
    active = dr.full(mi.Bool, True, vertices.count)
    vertex = vertices.at(dr.arange(mi.UInt32, vertices.count), active)
    si = vertex.si
    along_normal = mi.Vector3f(0, 0, dr.select(si.wi.z < 0, mi.Float(-1), 1))
    cosine = dr.maximum(dr.abs(si.wi.z), 1e-3)
    to_camera = mi.SurfaceInteraction3f(si)
    to_camera.wi = along_normal
    value, _pdf = eval_bsdf(si.bsdf(), mi.BSDFContext(), to_camera, si.wi, active)
    # Glossy surfaces scatter little along the normal: none is to be left out
    albedo = dr.clip(dr.pi * dr.max(value) / cosine, 0.05, 1)
    flux = dr.mean(dr.abs(vertex.β)) * albedo
    return dr.select(dr.isfinite(flux), flux, 0)


def _running_sums(lights: VirtualLights) -> np.ndarray:
    """Of each set: the running sums of the probabilities."""
    flux = emitted_flux(lights).numpy().astype(np.float64)
    sums = np.empty(len(flux), np.float32)
    for begin, number in zip(lights.begin.numpy(), lights.number.numpy()):
        part = slice(int(begin), int(begin + number))
        total = flux[part].sum()
        share = flux[part] / total if total > 0 else np.full(number, 1 / max(number, 1))
        probability = (1 - _DEFENSIVE) * share + _DEFENSIVE / max(number, 1)
        running = np.round(np.cumsum(probability) / _GRAIN) * _GRAIN
        if number:
            running[-1] = 1.0
        sums[part] = running
    return sums
