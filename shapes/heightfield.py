"""Grids of heights."""

from __future__ import annotations

from pathlib import Path

import drjit as dr
import mitsuba as mi
import numpy as np

from mitsuba_ext.scene.lightweight.geometry import Lightweight
from mitsuba_ext.scene.lightweight.height_tree import MAX_CELLS, HeightTree, cell
from mitsuba_ext.scene.lightweight.interaction import Triangle, surface_interaction
from mitsuba_ext.scene.placeholder import span
from mitsuba_ext.startup import registry
from mitsuba_ext.util.parameters import read_parameter

#: Where the heights may come from.
_SOURCES = ("filename", "bitmap", "data")


@registry.plugin
class Heightfield(mi.Mesh):
    r"""
    .. _shape-heightfield:

    Heightfields (:monosp:`heightfield`)
    ------------------------------------

    A regular grid of heights from an image: terrain, relief, waves. Each cell of the grid consists
    of two triangles, which are not stored: heights and acceleration structure take 5.4 bytes per
    cell, or 3.4 if the image has 8 or 16 bits. A mesh of the same triangles takes about 200 bytes
    per cell in Mitsuba.

    .. pluginparameters::

     * - filename
       - |string|
       - The image: PNG, EXR and all other formats that :monosp:`bitmap` reads. Its first channel is
         used as it is stored, and never converted from sRGB. Integers are divided by the largest
         value of their type, so heights are between 0 and 1.
     * - bitmap
       - |bitmap|
       - In place of :monosp:`filename`: an image in memory (from Python only).
     * - data
       - |tensor|
       - In place of :monosp:`filename`: a tensor of shape (rows, columns) or (rows, columns,
         channels) (from Python only).
     * - scale
       - |float|
       - The height of the value 1, before :monosp:`to_world`. It may be negative. (Default: 1)
     * - to_world
       - |transform|
       - Places the heightfield. Untransformed, it covers the square from (−1, −1) to (1, 1), as
         :monosp:`rectangle` does, with heights along z. Any invertible affine transform is
         accepted. (Default: none, i.e. identity)
     * - face_normals
       - |bool|
       - Whether shading normals are the normals of the triangles. Otherwise, they are interpolated
         from normals at the vertices, which follow from the differences of neighbouring heights.
         (Default: false)
     * - flip_normals
       - |bool|
       - Whether normals point down, towards lower z, instead of up. (Default: false)
     * - (nested plugin)
       - |bsdf| or |several|
       - The material, and the media :monosp:`interior` (below) and :monosp:`exterior` (above).

    **Use it when** a surface is given by heights: it takes a fraction of the memory of a mesh, and
    a grid of 4000 x 4000 cells is ready in half a second. **Not when** you have many small ones:
    each heightfield adds to the time that compiling kernels takes. **Not for lights:** an area
    light on it is refused. Compared with Embree and a mesh of the same triangles, in a grid of 1000
    x 1000 cells, camera rays take 1.2 to 1.6 times as long, and rays in all directions 1.3 to 1.5
    times (``docs/results/lightweight.md``).

    Texture coordinates are the same as on :monosp:`rectangle`, on which Mitsuba shows an image
    upside down: its first row is at y = −1. A :monosp:`bitmap` texture of the same image therefore
    lines up with the heights. However, its texels have their centres inside the square, whereas the
    outermost heights are on the sides of the square: towards the sides, the two differ by up to
    half a texel.

    Each cell is divided by the diagonal in the direction from (−1, −1) to (1, 1). The index of a
    triangle (:monosp:`prim_index`) holds the column of its cell in 15 bits, the row in the next 15,
    and one more bit for triangles to the right of the diagonal. A side has at least 2 and at most
    32769 heights. No ray passes between two triangles.

    Only integrators of this package see the surface. **Mitsuba's own**, such as :monosp:`path` or
    :monosp:`aov`, **render the scene without it, and we cannot make them refuse it**; use
    :monosp:`composed_path`, which is otherwise the same as :monosp:`path`. :monosp:`mi.traverse`
    shows the material, and a placeholder mesh in place of the heights, which cannot be changed
    after loading.

    Source: D. Cline, PhD dissertation, Brigham Young University, 2007, section 3.3.3 (lightweight
    bounding volumes of regular tessellations); here with ranges of heights instead of boxes, and
    grids of any size.

    .. tabs::
        .. code-tab:: xml

            <shape type="heightfield">
                <string name="filename" value="terrain.png"/>
                <float name="scale" value="0.2"/>
                <transform name="to_world">
                    <scale value="50"/>
                </transform>
                <bsdf type="diffuse"/>
            </shape>

        .. code-tab:: python

            'type': 'heightfield',
            'filename': 'terrain.png',
            'scale': 0.2,
            'to_world': mi.ScalarTransform4f().scale(50),
            'bsdf': {'type': 'diffuse'}
    """

    def __init__(self, props: mi.Properties) -> None:
        self.name = props.plugin_name()
        # The base class gets what a scene asks its shapes for
        own = mi.Properties(self.name)
        own.set_id(props.id())
        self._copy_objects(props, own)
        self._scale = read_parameter(self.name, props, "scale", 1.0)
        self._face_normals = read_parameter(self.name, props, "face_normals", False)
        self._flip_normals = read_parameter(self.name, props, "flip_normals", False)
        to_world = self._to_world(props)
        values, largest = self._heights(props)
        super().__init__(self.name, vertex_count=3, face_count=2, props=own)
        unit = self._scale / largest
        self._set_heights(values, unit, to_world)

    def _set_heights(self, values: np.ndarray, unit: float, to_world: np.ndarray) -> None:
        if unit == 0:
            values, unit = np.zeros_like(values), 1.0
        self._shape, self._type = values.shape, values.dtype
        try:
            self.lightweight = _Geometry(
                values, unit, to_world, not self._face_normals, self._flip_normals
            )
        except ValueError as error:
            raise self._error(str(error)) from None
        heights = [self.lightweight.tree.low * unit, self.lightweight.tree.high * unit]
        corners = [(x, y, z, 1) for x in (-1, 1) for y in (-1, 1) for z in heights]
        corners = (corners @ to_world.T)[:, :3]
        span(self, corners.min(axis=0), corners.max(axis=0))

    def to_string(self) -> str:
        rows, columns = self._shape
        return (
            f"{self.name}[\n  columns = {columns},\n  rows = {rows},\n  stored = {self._type},\n"
            f"  bytes = {self.lightweight.tree.nbytes},\n  scale = {self._scale:g},\n"
            f"  face_normals = {str(self._face_normals).lower()},\n"
            f"  flip_normals = {str(self._flip_normals).lower()}\n]"
        )

    # ---- Parameters ----

    def _copy_objects(self, props: mi.Properties, own: mi.Properties) -> None:
        for key, child in props.objects():
            if isinstance(child, mi.BSDF):
                own["bsdf"] = child
            elif isinstance(child, mi.Medium) and key in ("interior", "exterior"):
                own[key] = child
            elif isinstance(child, mi.Emitter):
                raise NotImplementedError(
                    f'"{self.name}": an area light ("{key}") cannot be on it; give the light to '
                    f"another shape, such as rectangle or a mesh"
                )
            elif key not in _SOURCES:
                raise self._error(
                    f'it cannot hold the {child.class_name()} "{key}"; it accepts a BSDF, and the '
                    f'media "interior" and "exterior"'
                )

    def _to_world(self, props: mi.Properties) -> np.ndarray:
        transform = props.get("to_world", mi.ScalarTransform4f())
        if not hasattr(transform, "matrix"):
            raise TypeError(
                f'"{self.name}": the parameter "to_world" is {transform!r}; it must be a transform'
            )
        matrix = np.array(transform.matrix, dtype=np.float64)
        if not np.array_equal(matrix[3], [0, 0, 0, 1]):
            raise self._error(
                f'the parameter "to_world" has the last row {matrix[3].tolist()}; it must be affine'
            )
        return matrix

    def _heights(self, props: mi.Properties) -> tuple[np.ndarray, int]:
        """The values (float32, float16 or uint16), and the largest one if they are integers."""
        given = [key for key in _SOURCES if key in props]
        if len(given) != 1:
            found = " and ".join(given) if given else "none"
            raise self._error(f'give one of "filename", "bitmap" and "data", found {found}')
        (key,) = given
        values = getattr(self, f"_read_{key}")(props[key])
        largest = 1
        if np.issubdtype(values.dtype, np.integer):
            largest = np.iinfo(values.dtype).max
            values = values.astype(np.uint16 if values.dtype in (np.uint8, np.uint16) else float)
        values = np.ascontiguousarray(values)
        if values.dtype == np.float64:
            with np.errstate(over="ignore"):  # infinite values are refused below
                values = values.astype(np.float32)
        self._check(values, key)
        return values, largest

    def _read_filename(self, name: str) -> np.ndarray:
        if not isinstance(name, str):
            raise TypeError(
                f'"{self.name}": the parameter "filename" is {name!r}; it must be of type string'
            )
        file = Path(str(mi.file_resolver().resolve(name)))
        if not file.is_file():
            raise self._error(f'filename: there is no file "{file}"')
        try:
            return self._read_bitmap(mi.Bitmap(str(file)))
        except RuntimeError as error:
            raise self._error(f'filename: "{file}" cannot be read as an image: {error}') from None

    def _read_bitmap(self, bitmap: mi.Bitmap) -> np.ndarray:
        if not isinstance(bitmap, mi.Bitmap):
            raise TypeError(
                f'"{self.name}": the parameter "bitmap" is of type {type(bitmap).__name__}; it '
                f"must be a mi.Bitmap"
            )
        values = np.array(bitmap, copy=False)
        return values if values.ndim == 2 else values[..., 0]

    def _read_data(self, tensor: mi.TensorXf) -> np.ndarray:
        if not dr.is_tensor_v(tensor) or not dr.is_float_v(tensor):
            raise TypeError(
                f'"{self.name}": the parameter "data" is of type {type(tensor).__name__}; it must '
                f"be a tensor of floats, such as mi.TensorXf"
            )
        values = np.array(tensor)
        if values.ndim not in (2, 3) or 0 in values.shape:
            raise self._error(
                f'the parameter "data" has the shape {values.shape}; it must be (rows, columns) or '
                f"(rows, columns, channels)"
            )
        return values if values.ndim == 2 else values[..., 0]

    def _check(self, values: np.ndarray, key: str) -> None:
        rows, columns = values.shape
        if not 2 <= min(values.shape) <= max(values.shape) <= MAX_CELLS + 1:
            raise self._error(
                f'the parameter "{key}" has {columns} x {rows} values; each side must have 2 to '
                f"{MAX_CELLS + 1}"
            )
        if not np.isfinite([values.min(), values.max()]).all():
            row = next(i for i, row in enumerate(values) if not np.isfinite(row).all())
            column = int(np.argmin(np.isfinite(values[row])))
            raise self._error(
                f'the parameter "{key}" has the value {values[row, column]} in column {column} of '
                f"row {row} (both from 0); heights must be finite in single precision"
            )

    def _error(self, text: str) -> ValueError:
        return ValueError(f'"{self.name}": {text}')


class _Geometry(Lightweight):
    """The surface of a heightfield.

    Parameters:
        values: The heights. Shape (rows, columns).
        unit: The height of the value 1.
        to_world: From the square [-1, 1]² and heights to world space. Shape (4, 4).
        has_normals: Whether shading normals are interpolated.
        is_flipped: Whether normals point to lower heights.

    Raises:
        ValueError: Nothing can be transformed to the space of the grid.
    """

    def __init__(
        self, values: np.ndarray, unit: float, to_world: np.ndarray, has_normals: bool,
        is_flipped: bool,
    ) -> None:  # fmt: skip
        rows, columns = values.shape
        # From columns, rows and values
        to_square = np.diag([2 / (columns - 1), 2 / (rows - 1), unit, 1])
        to_square[:2, 3] = -1
        matrix = to_world @ to_square
        with np.errstate(all="ignore"):
            inverse = np.linalg.inv(matrix) if np.linalg.det(matrix) != 0 else matrix * np.nan
            if not np.isfinite(inverse.astype(np.float32)).all():
                raise ValueError(
                    f'the parameters "to_world" and "scale" must give a transform that can be '
                    f"inverted, found the matrix {to_world.tolist()} and heights of {unit:g}"
                )
        is_mirrored = bool(np.linalg.det(to_world) < 0)
        # A mirrored triangle turns the other way round; the normals that are interpolated are on
        # the side that follows from its corners
        normals = inverse[:3, :3].T * (-1 if (unit < 0) != is_mirrored else 1)
        normals /= np.abs(normals).max()
        self.tree = HeightTree(values)
        self._to_world, self._to_grid, self._to_normal = (
            [mi.Vector3f(column[:3]) for column in m.T] for m in (matrix, inverse, normals)
        )
        self._cells = mi.Vector2f(columns - 1, rows - 1)
        # Opaque: other heightfields share the kernel
        dr.make_opaque(self._to_world, self._to_grid, self._to_normal, self._cells)
        self._has_normals, self._is_flipped = has_normals, is_flipped != is_mirrored

    def closest(self, ray, active):
        return self.tree.closest(self._in_grid(ray), active)

    def occluded(self, ray, active):
        return self.tree.occluded(self._in_grid(ray), active)

    def interaction(self, pi, ray):
        # Where there is no hit, anything that exists
        x, y, is_right = cell(dr.select(pi.valid, pi.prim_index, 0))
        # 00, 10 and 11 if it is the right triangle; else 00, 11 and 01
        second = (x + 1, dr.select(is_right, y, y + 1))
        third = (dr.select(is_right, x + 1, x), y + 1)
        vertices = [(x, y), second, third]
        triangle = Triangle(
            corners=[self._corner(*vertex) for vertex in vertices],
            normals=[self._normal(*vertex) for vertex in vertices] if self._has_normals else None,
            uv=[self._uv(*vertex) for vertex in vertices],
            is_flipped=self._is_flipped,
        )
        return surface_interaction(ray, pi, triangle)

    # ---- Vertices ----

    def _corner(self, x: mi.UInt32, y: mi.UInt32) -> mi.Point3f:
        height = self.tree.heights.at(x, y)
        return mi.Point3f(_transformed(self._to_world, _float(x), _float(y), height))

    def _normal(self, x: mi.UInt32, y: mi.UInt32) -> mi.Normal3f:
        """From central differences, and one-sided ones at the border."""
        heights = self.tree.heights
        left, right = dr.maximum(x, 1) - 1, dr.minimum(x + 1, heights.columns - 1)
        above, below = dr.maximum(y, 1) - 1, dr.minimum(y + 1, heights.rows - 1)
        # Two vertices apart, or one at the border
        along_x = (heights.at(right, y) - heights.at(left, y)) / _float(right - left)
        along_y = (heights.at(x, below) - heights.at(x, above)) / _float(below - above)
        n = _transformed(self._to_normal, -along_x, -along_y, mi.Float(1))
        return mi.Normal3f(dr.normalize(n))

    def _uv(self, x: mi.UInt32, y: mi.UInt32) -> mi.Point2f:
        return mi.Point2f(_float(x), _float(y)) / self._cells

    def _in_grid(self, ray: mi.Ray3f) -> mi.Ray3f:
        """A ray in the space of the grid. Its direction is not normalized: distances remain."""
        result = mi.Ray3f(ray)
        result.o = mi.Point3f(_transformed(self._to_grid, *ray.o))
        result.d = _transformed(self._to_grid[:3], *ray.d)
        return result


def _transformed(columns: list[mi.Vector3f], x, y, z) -> mi.Vector3f:
    """A point, or a direction if there is no fourth column."""
    a, b, c, *origin = columns
    last = dr.fma(c, z, origin[0]) if origin else c * z
    return dr.fma(a, x, dr.fma(b, y, last))


def _float(number: mi.UInt32) -> mi.Float:
    return mi.Float(mi.Int32(number))
