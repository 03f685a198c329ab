"""Meshes whose acceleration structure takes little memory."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi

from mitsuba_ext.scene.bounds import shape_bounds
from mitsuba_ext.scene.lightweight.mesh_geometry import MeshGeometry
from mitsuba_ext.scene.lightweight.packed_mesh import PackedMesh
from mitsuba_ext.scene.placeholder import span
from mitsuba_ext.startup import registry
from mitsuba_ext.util.parameters import read_parameter


@registry.plugin
class LightweightMesh(mi.Mesh):
    r"""
    .. _shape-lightweight_mesh:

    Lightweight meshes (:monosp:`lightweight_mesh`)
    -----------------------------------------------

    Finds the triangles of a nested mesh with an acceleration structure of 3.3 bytes per triangle.
    Embree's structure, in Mitsuba, takes about 70 bytes per triangle, and 110 while it is built.

    .. pluginparameters::

     * - (nested plugin)
       - |shape|
       - The mesh: :monosp:`ply`, :monosp:`obj`, :monosp:`serialized`, or any other shape that
         Mitsuba represents by triangles, with its material, and with its light or media, if it has
         any.
     * - quantized
       - |bool|
       - Whether vertices are rounded to 65536 steps along each axis of the mesh's bounding box,
         normals to steps of a few thousandths of a degree, and texture coordinates to 65536 steps
         between their smallest and largest value. The mesh then takes 12 to 16 bytes per triangle
         in all, or more if vertices are shared by few triangles; otherwise, 21 to 31 bytes, as
         Mitsuba stores it. (Default: false)

    **Use it when** a scene does not fit into memory: scans, displaced surfaces, terrain. For a
    regular grid of heights, :monosp:`heightfield` takes far less memory. **Not when** the scene
    fits: all rays that meet the bounding box of the mesh take longer. Compared with Embree, in a
    mesh of a million triangles, camera rays take 3.6 times as long, rays in all directions 3.5
    times, shadow rays 2.2 times; more for a whole scene as one mesh (5 to 7 times for rays in all
    directions, ``docs/results/lightweight.md``). Each lightweight mesh has its own structure and
    adds to the time that compiling kernels takes: use it for a few large meshes, not for many small
    ones.

    All surface data of the mesh are the same as in Mitsuba: normals, texture coordinates, vertex
    and face attributes, materials, media, and area lights of any type. Triangles are sorted: the
    variable :monosp:`prim_index` numbers them in a different order than the file. No ray passes
    between two triangles that share an edge or a vertex. With Embree, as Mitsuba uses it, one in
    seven rays aimed exactly at an edge does.

    With :monosp:`quantized`, area lights and attributes are refused. Touching meshes are each
    rounded on a grid of their own, so there may be gaps of one step between them.

    Only integrators of this package see these triangles. **Mitsuba's own**, such as :monosp:`path`
    or :monosp:`aov`, **render the scene without them, and we cannot make them refuse it** (a light
    among them is still sampled, with a wrong weight); use :monosp:`composed_path`, which is
    otherwise the same as :monosp:`path`. The parameter :monosp:`aovs` of our integrators supports
    them; its :monosp:`sh_normal` ignores normal and bump maps.

    A lightweight mesh cannot be nested in :monosp:`moving`, and is invisible in a
    :monosp:`shapegroup`. :monosp:`mi.traverse` shows its material and its light, and a placeholder
    in place of its vertices: they cannot be changed after loading.

    Source: D. Cline, PhD dissertation, Brigham Young University, 2007, chapter 3: complete trees of
    four children, without pointers, and with four triangles in each leaf. Here, each tree holds 64
    triangles; above these trees, a tree is split by surface areas (I. Wald, *On fast Construction
    of SAH-based Bounding Volume Hierarchies*, IEEE Symposium on Interactive Ray Tracing, 2007).
    Boxes are bytes relative to their own node, as in H. Ylitie, T. Karras, S. Laine, *Efficient
    Incoherent Ray Traversal on GPUs Through Compressed Wide BVHs*, HPG 2017. The test of triangles
    follows S. Woop, C. Benthin, I. Wald, *Watertight Ray/Triangle Intersection*, JCGT 2(1), 2013.

    .. tabs::
        .. code-tab:: xml

            <shape type="lightweight_mesh">
                <boolean name="quantized" value="true"/>
                <shape type="ply">
                    <string name="filename" value="statue.ply"/>
                    <bsdf type="roughplastic"/>
                </shape>
            </shape>

        .. code-tab:: python

            'type': 'lightweight_mesh',
            'quantized': True,
            'mesh': {
                'type': 'ply',
                'filename': 'statue.ply',
                'bsdf': {'type': 'roughplastic'}
            }
    """

    def __init__(self, props: mi.Properties) -> None:
        self.name = props.plugin_name()
        self.quantized = read_parameter(self.name, props, "quantized", False)
        mesh = self._nested(props)
        if self.quantized:
            self._refuse_what_is_not_packed(mesh)
        self.triangles = mesh.face_count()
        # The base class gets what a scene asks its shapes for
        own = mi.Properties(self.name)
        own.set_id(props.id())
        parts = {
            "bsdf": mesh.bsdf(), "emitter": mesh.emitter(),
            "interior": mesh.interior_medium(), "exterior": mesh.exterior_medium(),
        }  # fmt: skip
        for key, part in parts.items():
            if part is not None:
                own[key] = part
        super().__init__(self.name, vertex_count=3, face_count=2, props=own)
        self._span(mesh)
        self.lightweight = PackedMesh(mesh) if self.quantized else MeshGeometry(mesh)
        dr.flush_malloc_cache()  # what building has needed

    def to_string(self) -> str:
        return (
            f"{self.name}[\n  triangles = {self.triangles},\n"
            f"  quantized = {str(self.quantized).lower()},\n"
            f"  memory = {self.lightweight.nbytes / self.triangles:.1f} bytes per triangle\n]"
        )

    # ---- Helpers ----

    def _span(self, mesh: mi.Mesh) -> None:
        box = shape_bounds(mesh)
        try:
            span(self, box.min, box.max)
        except RuntimeError:
            # Mitsuba would now make this the shape of the emitter, which already has one: the
            # mesh. That is what we need. All else is done by then.
            if not mesh.is_emitter():
                raise

    def _nested(self, props: mi.Properties) -> mi.Mesh:
        shapes = list(props.objects())
        if len(shapes) != 1:
            raise self._error(f"one mesh must be nested in it, found {len(shapes)} objects")
        ((key, shape),) = shapes
        if not isinstance(shape, mi.Shape):
            raise self._error(
                f'what is nested in it must be a mesh, found {shape.class_name()} ("{key}"); '
                f"materials, lights and media belong into the nested mesh"
            )
        is_ours = hasattr(shape, "motion") or hasattr(shape, "lightweight")
        # Mitsuba's rectangle calls itself a mesh, but has no faces that could be sorted
        if is_ours or not shape.is_mesh() or "faces" not in mi.traverse(shape):
            raise self._error(
                f"only a mesh of triangles of Mitsuba can be nested in it, such as ply, obj or "
                f"serialized; found {shape.class_name()}"
            )
        if shape.is_sensor():
            raise self._error("a mesh that is a sensor cannot be nested in it")
        if shape.face_count() == 0:
            raise self._error("the nested mesh has no triangles")
        return shape

    def _refuse_what_is_not_packed(self, mesh: mi.Mesh) -> None:
        if mesh.is_emitter():
            raise self._error(
                'a mesh that emits light cannot be quantized: leave out "quantized", or its emitter'
            )
        own = ("faces", "vertex_positions", "vertex_normals", "vertex_texcoords")
        keys = [key for key in mi.traverse(mesh).keys() if key.startswith(("vertex_", "face_"))]
        attributes = [key for key in keys if key not in own]
        if attributes:
            raise self._error(
                f'the attribute "{attributes[0]}" of the nested mesh cannot be quantized: leave '
                f'out "quantized", or use a texture'
            )

    def _error(self, text: str) -> ValueError:
        return ValueError(f'"{self.name}": {text}')
