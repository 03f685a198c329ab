"""The samples of masks: which object and which material each camera ray of a render meets."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import drjit as dr
import mitsuba as mi

from ..images.coverage import Coverage
from ..scene.surface_names import SurfaceNames, surface_names
from ..transport.estimator import CameraRays
from ..transport.queries.scene import scene_query
from ..transport.queries.visible_surface import material_number, object_number, visible_surface
from ..transport.scene_query import SceneQuery
from .pixel_weights import PixelWeights


@dataclass
class LabelledSamples:
    """What masks need to know of samples.

    Attributes:
        position: Where they are on the film.
        weight: Their weights.
        label: What they show (:class:`~mitsuba_ext.images.coverage.Coverage`).
    """

    position: mi.Point2f
    weight: mi.Float
    label: mi.UInt32


@dataclass(frozen=True)
class Labels:
    """Labels camera rays by what they meet.

    Parameters:
        query: How rays intersect the scene.
        names: The names of its objects and materials.
        hide_emitters: Whether camera rays pass through area lights.
        objects, materials: The names that are told apart.
    """

    query: SceneQuery
    names: SurfaceNames
    hide_emitters: bool
    objects: tuple[str, ...]
    materials: tuple[str, ...]

    @property
    def count(self) -> int:
        """The number of labels."""
        return (len(self.objects) + 1) * (len(self.materials) + 1)

    def of(
        self, scene: mi.Scene, rays: CameraRays, count: mi.Float | float
    ) -> LabelledSamples:
        """The samples of these rays, and ``count``, the weight of each. From now on, ``rays`` know
        the first surface that each of them meets."""
        ray = mi.Ray3f(rays.ray)
        rays.first = self.query.closest(scene, ray, coherent=True, active=mi.Bool(True))
        found = visible_surface(
            self.query, scene, ray, rays.first, self.names, self.hide_emitters
        )
        label = mi.UInt32(0)
        if self.objects:
            count_of_materials = dr.opaque(mi.UInt32, len(self.materials) + 1)
            label += object_number(self.names, found) * count_of_materials
        if self.materials:
            label += material_number(self.names, found)
        weight = mi.Float(rays.weight * count) + dr.zeros(mi.Float, dr.width(rays.position))
        return LabelledSamples(rays.position, weight, label)


class MaskSamples:
    """Adds up the weights of samples by object and material.

    Parameters:
        plugin: The integrator.
        scene, film: What is rendered.
        masks: The names and types of the masks.
        hide_emitters: Whether camera rays pass through area lights.

    Attributes:
        labels: Labels the samples.
        taken: Samples that are not added yet.

    Raises:
        ValueError: The names of the objects are lost.
    """

    def __init__(
        self, plugin: str, scene: mi.Scene, film: mi.Film, masks: Sequence[tuple[str, str]],
        hide_emitters: bool,
    ) -> None:  # fmt: skip
        names = surface_names(scene)
        self.labels = Labels(
            scene_query(scene), names, hide_emitters,
            names.objects if _any_of("object", masks) else (),
            names.materials if _any_of("material", masks) else (),
        )  # fmt: skip
        if self.labels.objects and names.merged:
            raise ValueError(
                f'"{plugin}": Mitsuba has merged the meshes {names.merged}, and a mask cannot tell '
                f"them apart: load the scene with mi.load_file(…, optimize=False), or "
                f'mi.load_dict(…, optimize=False), and give each "merge" in it an id'
            )
        self._size = tuple(int(x) for x in film.crop_size())
        self._weights = PixelWeights(film, self.labels.count)
        self.taken: list[LabelledSamples] = []

    def put(self) -> None:
        """Adds the samples taken, which are evaluated together with the samples of the image."""
        for sample in self.taken:
            self._weights.put(sample.position, sample.weight, sample.label)
        self.taken.clear()

    def clear(self) -> None:
        """Forgets all samples."""
        self._weights.clear()

    def coverage(self) -> Coverage:
        """The coverage by all samples."""
        pixel, label, weight = self._weights.arrays()
        names = self.labels.objects, self.labels.materials
        return Coverage(self._size, *names, pixel, label, weight)


def _any_of(level: str, masks: Sequence[tuple[str, str]]) -> bool:
    """Whether any of the masks is of objects, or of materials."""
    return any(level in kind for _name, kind in masks)
