"""The channels of light path expressions: what a path gains is added to the *cell* of its events
(``path_events.py``), and a channel is the sum of the cells of its expression.

The sums are a part of the state of a path (:class:`.vertex.PathState`), as its radiance is."""

from __future__ import annotations

from collections.abc import Sequence

import drjit as dr
import mitsuba as mi
import numpy as np

from ..scene.expressions.notation import Expression
from ..util.arrays import from_numpy
from ..util.spectra import film_colours
from .estimator import CameraRays
from .event_tables import any_of
from .path_events import PathEvents
from .vertex import PathState, Vertex


# Not a dataclass: Dr.Jit would treat a dataclass used in a loop as part of the loop's state
class PathChannels(PathEvents):
    """Adds the light of paths to the channels of expressions.

    Parameters:
        scene: The scene.
        expressions: The expressions, one for each channel.

    Raises:
        ValueError: A label of an expression is not in the scene, or the expressions are too
            complex.
    """

    def __init__(self, scene: mi.Scene, expressions: Sequence[Expression]) -> None:
        super().__init__(scene, expressions)
        # The cells of each expression; cell 0 is not summed
        cells = list(enumerate(self.cells))[1:]
        self._of = [[i - 1 for i, c in cells if k in c] for k in range(len(expressions))]
        self._accepts = from_numpy(mi.UInt32, _masks(self.cells, len(expressions)))

    @property
    def sample_bytes(self) -> int:
        """The memory of the channels of a sample in a pass."""
        return 4 * len(self._of) * len(mi.Spectrum())

    # ---- Along a path ----

    def sums(self) -> list[mi.Spectrum]:
        """The sums of the cells before the first vertex."""
        return [mi.Spectrum(0) for _ in self.cells[1:]]

    def emitted(
        self, path: PathState, emitter: mi.EmitterPtr, value: mi.Spectrum, active: mi.Bool
    ) -> None:
        """The path has hit a light, and gains ``value``."""
        _add(path, self.at_light(path, emitter), value, active)

    def connected(
        self,
        vertex: Vertex,
        ds: mi.DirectionSample3f,
        bsdf_value: mi.Spectrum,
        value: mi.Spectrum,
        active: mi.Bool,
    ) -> None:
        """``vertex`` was connected to a light, towards which the BSDF has the value ``bsdf_value``,
        and the path gains ``value``."""
        wo = vertex.si.to_local(ds.d)
        cells = self.at_connection(vertex, wo, ds.emitter)
        known = vertex.lobes and vertex.lobes.connected
        self._divide(vertex, wo, bsdf_value, *cells, value, active, known)

    def joined(
        self,
        vertex: Vertex,
        wo: mi.Vector3f,
        bsdf_value: mi.Spectrum,
        others: list[mi.UInt32],
        value: mi.Spectrum,
        active: mi.Bool,
    ) -> None:
        """The path gains ``value`` from light paths with the states ``others``, whose light arrives
        at ``vertex`` from the local direction ``wo``. The BSDF has the value ``bsdf_value``
        there."""
        cells = self.at_joint(vertex, wo, others)
        self._divide(vertex, wo, bsdf_value, *cells, value, active)

    def joined_in_medium(
        self, path: PathState, others: list[mi.UInt32], value: mi.Spectrum, active: mi.Bool
    ) -> None:
        """As :meth:`joined`, at a point of a medium on the way to the next vertex of ``path``."""
        _add(path, self.in_medium(path, others), value, active)

    def _divide(
        self,
        vertex: Vertex,
        wo: mi.Vector3f,
        whole: mi.Spectrum,
        diffuse: list[mi.UInt32],
        glossy: list[mi.UInt32],
        value: mi.Spectrum,
        active: mi.Bool,
        known: mi.Spectrum | None = None,
    ) -> None:
        """Divides the ``value`` of a connection among the cells for diffuse and glossy lobes, whose
        values add up to ``whole``."""
        # Where both belong to the same channels, no lobe is evaluated
        divides = active & any_of(one != other for one, other in zip(diffuse, glossy))
        share = self.share(vertex, wo, whole, divides, known)
        if self.colours == 1:
            is_diffuse = share > 0
            cells = [dr.select(is_diffuse, one, other) for one, other in zip(diffuse, glossy)]
            _add(vertex.path, cells, value, active)
            return
        share = dr.select(divides, share, 1)
        _add(vertex.path, diffuse, value * share, active)
        _add(vertex.path, glossy, value * (1 - share), divides)

    # ---- What comes out ----

    def values(self, sums: list[mi.Spectrum], rays: CameraRays) -> list[mi.Float]:
        """The channels of each path: the colours of the first expression, and so on."""
        parts = [sum((sums[cell] for cell in cells), mi.Spectrum(0)) for cells in self._of]
        return self.colours_of(parts, rays)

    def colours_of(self, parts: list[mi.Spectrum], rays: CameraRays) -> list[mi.Float]:
        """The colours in the film of what each channel gains."""
        found = []
        for part in parts:
            found += film_colours(part * rays.importance, rays.ray.wavelengths)
        return found

    def splatted(self, others: list[mi.UInt32], value: mi.Spectrum) -> list[mi.Spectrum]:
        """The part of ``value`` that each channel gains where light paths with the states
        ``others`` reach the sensor."""
        return self.parts(self.at_camera(others), value)

    def parts(self, cells: list[mi.UInt32], value: mi.Spectrum) -> list[mi.Spectrum]:
        """The part of ``value`` that each channel gains from paths in these cells."""
        found, words = [], -(-len(self._of) // 32)
        for index in range(len(self._of)):
            belongs = [
                (dr.gather(mi.UInt32, self._accepts, c * words + index // 32) >> index % 32) & 1
                for c in cells
            ]
            belongs = belongs * len(value) if len(belongs) < len(value) else belongs
            found.append(mi.Spectrum(*(dr.select(b == 1, v, 0) for b, v in zip(belongs, value))))
        return found


def _add(path: PathState, cells: list[mi.UInt32], value: mi.Spectrum, active: mi.Bool) -> None:
    """Adds a value to cells: to one, or each colour to its own."""
    cells = cells * len(value) if len(cells) < len(value) else cells
    for index, total in enumerate(path.sums):
        parts = (
            dr.select(active & (cell == index + 1), part + more, part)
            for cell, part, more in zip(cells, total, value)
        )
        path.sums[index] = mi.Spectrum(*parts)


def _masks(cells: Sequence[frozenset[int]], count: int) -> np.ndarray:
    """A bit for each of ``count`` expressions: whether it has a cell. A word has 32 bits."""
    masks = np.zeros((len(cells), -(-count // 32)), np.uint32)
    for row, cell in zip(masks, cells):
        for index in cell:
            row[index // 32] |= np.uint32(1 << index % 32)
    return masks
