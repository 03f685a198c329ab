"""The samples of masks: which object and which material each camera ray of a render meets."""

from __future__ import annotations

from collections.abc import Sequence

import drjit as dr
import mitsuba as mi

from ..images.coverage import Coverage
from ..scene.surface_names import surface_names
from ..transport.estimator import CameraRays
from ..transport.queries.scene import scene_query
from ..transport.queries.visible_surface import material_number, object_number, visible_surface
from .pixel_weights import PixelWeights


class MaskSamples:
    """Adds up the weights of samples by object and material.

    Parameters:
        plugin: The integrator.
        scene, film: What is rendered.
        masks: The names and types of the masks.
        hide_emitters: Whether camera rays pass through area lights.

    Attributes:
        taken: Position, weight and label of samples that are not added yet.

    Raises:
        ValueError: The names of the objects are lost.
    """

    def __init__(
        self, plugin: str, scene: mi.Scene, film: mi.Film, masks: Sequence[tuple[str, str]],
        hide_emitters: bool,
    ) -> None:  # fmt: skip
        self._scene, self._query, self._hides = scene, scene_query(scene), hide_emitters
        self._names = names = surface_names(scene)
        self._objects = names.objects if _any_of("object", masks) else ()
        self._materials = names.materials if _any_of("material", masks) else ()
        if self._objects and names.merged:
            raise ValueError(
                f'"{plugin}": Mitsuba has merged the meshes {names.merged}, and a mask cannot tell '
                f"them apart: load the scene with mi.load_file(…, optimize=False), or "
                f'mi.load_dict(…, optimize=False), and give each "merge" in it an id'
            )
        self._size = tuple(int(x) for x in film.crop_size())
        labels = (len(self._objects) + 1) * (len(self._materials) + 1)
        self._weights = PixelWeights(film, labels)
        self.taken: list[tuple[mi.Point2f, mi.Float, mi.UInt32]] = []

    def take(self, rays: CameraRays, count: mi.Float | float) -> None:
        """Takes samples. ``count`` is the weight of each."""
        found = visible_surface(self._query, self._scene, rays.ray, self._names, self._hides)
        label = mi.UInt32(0)
        if self._objects:
            count_of_materials = dr.opaque(mi.UInt32, len(self._materials) + 1)
            label += object_number(self._names, found) * count_of_materials
        if self._materials:
            label += material_number(self._names, found)
        weight = mi.Float(rays.weight * count) + dr.zeros(mi.Float, dr.width(rays.position))
        self.taken.append((rays.position, weight, label))

    def put(self) -> None:
        """Adds the samples taken, which are evaluated together with the samples of the image."""
        for position, weight, label in self.taken:
            self._weights.put(position, weight, label)
        self.taken.clear()

    def clear(self) -> None:
        """Forgets all samples."""
        self._weights.clear()

    def coverage(self) -> Coverage:
        """The coverage by all samples."""
        pixel, label, weight = self._weights.arrays()
        return Coverage(self._size, self._objects, self._materials, pixel, label, weight)


def _any_of(level: str, masks: Sequence[tuple[str, str]]) -> bool:
    """Whether any of the masks is of objects, or of materials."""
    return any(level in kind for _name, kind in masks)
