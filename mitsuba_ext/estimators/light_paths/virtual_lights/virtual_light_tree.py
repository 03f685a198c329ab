"""Choosing virtual lights by a light tree: a stochastic light cut of one light.

Each set has a tree over its virtual lights (:mod:`~mitsuba_ext.scene.lights.light_tree`). A choice
goes down from the root, and takes a child with a probability proportional to an estimate of what
its virtual lights contribute: their flux, times a geometry term, at most the bound.

Source: B. Walter et al., *Lightcuts: A Scalable Approach to Illumination*, ACM Transactions on
Graphics 24(3), 2005 (trees of virtual lights).
"""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np

from ....scene.bsdfs import is_in_table, opaque_bsdfs
from ....scene.lights.light_tree import LightTree, Receiver
from ....scene.lights.tree_construction import Lights, build_trees
from ....scene.regions.surface_voxels import lit_normal
from ....util.arrays import from_numpy
from ..vertex_choice import Chosen
from .virtual_light_choice import emitted_flux
from .virtual_lights import VirtualLights


class ClusteredChoice:
    """Chooses a virtual light of the lane's set by the tree.

    Parameters:
        lights: The virtual lights.
        set_index: The set of each lane.
        largest: The bound of the geometry term.
    """

    is_stratified = True

    def __init__(self, lights: VirtualLights, set_index: mi.UInt32, largest: mi.Float) -> None:
        flux = emitted_flux(lights)
        # Not from virtual lights that emit nothing
        vertex = np.flatnonzero(flux > 0)
        number = lights.number.numpy().astype(np.int64)
        owner = np.repeat(np.arange(lights.set_count), number)[vertex]
        trees = build_trees(_seen_from_afar(lights, flux, vertex), owner, lights.set_count)
        # Passes share a recording if their arrays have the same size
        room = lights.vertices.room
        self._tree = LightTree(trees.padded(2 * room + lights.set_count, room), False, largest)
        self._vertex = from_numpy(mi.UInt32, np.append(vertex, np.zeros(room - len(vertex))))
        self._root = mi.UInt32(set_index)
        has_light = np.bincount(owner, minlength=lights.set_count) > 0
        self._exists = dr.gather(mi.Bool, from_numpy(mi.Bool, has_light), set_index)
        self._share, self._opaque = lights.share, opaque_bsdfs(lights.scene)
        dr.eval(self._root, self._exists)

    def numbers(self, sampler):
        return (sampler.next_2d(),)

    def choose(self, numbers, vertex, active):
        si = vertex.si
        normal = dr.mulsign(si.sh_frame.n, si.wi.z)
        receiver = Receiver(normal, is_in_table(self._opaque, si.bsdf()))
        exists = active & self._exists
        light, probability = self._tree.choose(self._root, numbers[0], si.p, receiver, exists)
        exists &= probability > 0
        index = dr.gather(mi.UInt32, self._vertex, light, exists)
        return Chosen(index, self._share / dr.select(exists, probability, 1), exists)


def _seen_from_afar(lights: VirtualLights, flux: np.ndarray, vertex: np.ndarray) -> Lights:
    """What the virtual lights at these vertices look like from afar."""
    vertices = lights.vertices
    active = dr.full(mi.Bool, True, vertices.count)
    si = vertices.at(dr.arange(mi.UInt32, vertices.count), active).si
    normal = lit_normal(si)
    # Light leaves on both sides
    transmits = mi.has_flag(si.bsdf().flags(), mi.BSDFFlags.Transmission)
    normal, position = dr.select(transmits, 0, normal), mi.Point3f(si.p)
    dr.eval(position, normal)
    p, n = (x.numpy().T[vertex].astype(np.float64) for x in (position, normal))
    size = np.zeros(len(vertex))
    strength = np.maximum(flux[vertex] / max(flux.max(initial=0), 1e-300), 1e-30)
    # Shading normals may differ from the geometric ones: light may leave at any angle
    return Lights(p, size, size, n, np.full(len(vertex), np.pi), strength)
