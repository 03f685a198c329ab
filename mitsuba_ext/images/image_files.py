"""Reads and writes images. A file is replaced as a whole, never left half written. An EXR holds
metadata about its render.

EXRs are read with ``mi.Bitmap`` because the OpenEXR package, for a damaged file, prints warnings to
the terminal and returns an empty image.
"""

from __future__ import annotations

import contextlib
import hashlib
import json
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from ..startup.machine import memory_bytes
from ..util import files
from ..util.errors import InputError, one_line
from ..util.files import replacing

if TYPE_CHECKING:
    import mitsuba as mi

#: The first bytes of an EXR.
_MAGIC = b"\x76\x2f\x31\x01"

#: Extensions that ``write_film`` can write.
EXTENSIONS = (".exr", ".png", ".jpg", ".jpeg", ".hdr", ".pfm")

#: Mitsuba's names of their formats.
_FORMATS = dict(zip(EXTENSIONS, ("OpenEXR", "PNG", "JPEG", "JPEG", "RGBE", "PFM")))

#: The EXR header attribute that holds the checksum of channels and metadata, and the names of the
#: attributes that it covers.
_CHECKSUM = "checksum"

#: Attributes that Mitsuba overwrites.
_OF_MITSUBA = ("generatedBy", "pixelAspectRatio", "screenWindowWidth")

#: The attribute with the render's warnings, a list of sentences as JSON.
REMARKS = "remarks"

#: The text of :func:`fault_of` about files of earlier versions and of other programs.
NO_CHECKSUM = "it has no checksum, like files of earlier versions"


def check_target(path: Path) -> None:
    """Raises :class:`InputError` if no image can be written to ``path``; for use before a render
    that may take hours."""
    files.check_target(path)
    if path.suffix.lower() not in EXTENSIONS:
        found = f'the extension "{path.suffix}"' if path.suffix else "a name without extension"
        raise InputError(f"{path}: {found} cannot be written ({' '.join(EXTENSIONS)} can)")


def check_exr_target(path: Path) -> None:
    """Raises :class:`InputError` if no EXR can be made at ``path``, or if another kind of file
    exists there: a path named by a scene must not replace other files."""
    files.check_target(path)
    if path.suffix.lower() != ".exr":
        raise InputError(f'{path}: has the extension "{path.suffix}", and not ".exr"')
    if not path.exists():
        return
    is_exr = False
    if path.is_file():
        with path.open("rb") as file:
            is_exr = file.read(4) == _MAGIC
    if not is_exr:
        raise InputError(
            f"{path}: is another file, which is not replaced: delete it, or name another one"
        )


def write_exr(
    path: Path, pixels: np.ndarray, channels: Sequence[str], metadata: Mapping[str, object]
) -> None:
    """Writes 32-bit channels; ``pixels`` has the shape (height, width, number of channels). The
    file holds a checksum of them and of ``metadata`` (:func:`fault_of`)."""
    _save(_exr(pixels, channels, metadata), path)


def _exr(
    pixels: np.ndarray, channels: Sequence[str], metadata: Mapping[str, object]
) -> mi.Bitmap:
    import mitsuba as mi

    pixels = np.ascontiguousarray(pixels, dtype=np.float32)
    # Without the format, up to four channels would be called R, G, B and A
    bitmap = mi.Bitmap(pixels, mi.Bitmap.PixelFormat.MultiChannel, list(channels))
    header = {key: _attribute(value) for key, value in metadata.items()}
    planes = {name: pixels[:, :, index] for index, name in enumerate(channels)}
    covered = {key: header[key] for key in header.keys() - {_CHECKSUM, *_OF_MITSUBA}}
    header[_CHECKSUM] = json.dumps([_checksum(planes, covered), *covered])
    attributes = bitmap.metadata()
    for key, value in header.items():
        attributes[key] = value
    return bitmap


def fault_of(planes: Mapping[str, np.ndarray], metadata: Mapping[str, object]) -> str:
    """How an EXR's channels and metadata differ from what :func:`write_exr` wrote, or empty."""
    if _CHECKSUM not in metadata:
        return NO_CHECKSUM
    try:
        checksum, *keys = json.loads(str(metadata[_CHECKSUM]))
        if checksum == _checksum(planes, {key: metadata[key] for key in keys}):
            return ""
    except (ValueError, TypeError, KeyError):
        pass
    return "its content does not match its checksum"


def remarks_of(planes: Mapping[str, np.ndarray], metadata: Mapping[str, object]) -> list[str]:
    """Warnings about an image that the user names: the remarks of
    :func:`mitsuba_ext.inputs.scene_remarks` at its render, and whether the file has changed
    since."""
    remarks = []
    with contextlib.suppress(ValueError):
        found = json.loads(str(metadata.get(REMARKS, "[]")))
        remarks += [str(remark) for remark in found] if isinstance(found, list) else []
    if (fault := fault_of(planes, metadata)) and fault != NO_CHECKSUM:
        remarks.append(f"{fault}: it was damaged, or edited")
    return remarks


def _checksum(planes: Mapping[str, np.ndarray], header: Mapping[str, object]) -> str:
    """SHA-256 of channels, their names, and attributes of the header."""
    sha = hashlib.sha256(json.dumps(header, sort_keys=True).encode())
    for name, plane in sorted(planes.items()):
        sha.update(f"{name} {plane.shape}".encode())
        sha.update(np.ascontiguousarray(plane, dtype="<f4").tobytes())
    return sha.hexdigest()


def write_exr_fast(
    path: Path, planes: Mapping[str, np.ndarray], metadata: Mapping[str, object]
) -> None:
    """Writes 32-bit channels, (height, width), without compression: files of noisy images are 1.1
    times as large, and take a sixth of the time to write."""
    import OpenEXR

    header = {key: _attribute(value) for key, value in metadata.items()}
    header.update(compression=OpenEXR.NO_COMPRESSION, type=OpenEXR.scanlineimage)
    planes = {key: np.ascontiguousarray(x, dtype=np.float32) for key, x in planes.items()}
    with replacing(path) as temporary:
        try:
            OpenEXR.File(header, planes).write(str(temporary))
        except RuntimeError as error:
            raise OSError(f"{path}: {one_line(error)}") from error


def read_exr(path: Path) -> tuple[dict[str, np.ndarray], dict[str, object]]:
    """Reads the channels of an EXR as 32-bit arrays by name, and its metadata.

    Raises:
        InputError: The file is missing, damaged, or not an EXR.
    """
    import mitsuba as mi

    bitmap, names, metadata = open_bitmap(path)
    if bitmap.component_format() not in (mi.Struct.Type.Float16, mi.Struct.Type.Float32):
        raise InputError(f"{path}: not a floating-point image")
    pixels = np.array(bitmap, dtype=np.float32)
    pixels = pixels.reshape(pixels.shape[0], pixels.shape[1], -1)
    return {name: pixels[:, :, index] for index, name in enumerate(names)}, metadata


def open_bitmap(path: Path) -> tuple[mi.Bitmap, list[str], dict[str, object]]:
    """Opens any image that Mitsuba can read, whatever its extension.

    Returns:
        The image, the names of its channels, and its metadata, without texts that are not UTF-8.

    Raises:
        InputError: The file is missing, damaged, or not an image.
    """
    import mitsuba as mi

    check_file(path)
    try:
        bitmap = mi.Bitmap(str(path))
        names = [entry.name for entry in bitmap.struct_()]
    except MemoryError as error:
        raise InputError(f"{path}: unreadable (its size needs too much memory)") from error
    except Exception as error:  # Mitsuba's readers raise many kinds
        reason = one_line(error).replace(f'"{path}": ', "")
        raise InputError(f"{path}: unreadable ({reason})") from error
    metadata: dict[str, object] = {}
    with contextlib.suppress(UnicodeDecodeError):  # of a key
        for key in bitmap.metadata().keys():
            with contextlib.suppress(UnicodeDecodeError):  # of its value
                metadata[key] = bitmap.metadata()[key]
    return bitmap, names, metadata


def check_file(path: Path) -> None:
    """Raises :class:`InputError` if the file does not exist."""
    if not path.is_file():
        raise InputError(f"{path}: {'is not a file' if path.exists() else 'no such file'}")


def check_film(path: Path, film: mi.Film, aovs: Sequence[str]) -> None:
    """Checks, before a render, that there is memory for an image of ``film``, and that it can be
    written to ``path``: writes one black pixel in the same folder.

    Raises:
        InputError: The image does not fit into memory, or cannot be written.
    """
    import mitsuba as mi

    is_special = mi.has_flag(film.flags(), mi.FilmFlags.Special)
    if is_special and path.suffix.lower() != ".exr":
        raise InputError(
            f'{path}: the film "{film.class_name()}" has no RGB image: write it to an .exr'
        )
    try:
        with _of_one_pixel(film):
            channels = film.prepare(list(aovs))
            with files.beside(path) as temporary:
                temporary.write_bytes(_encoded(_bitmap(path, film, {}, {}), path))
    except (OSError, RuntimeError) as error:
        reason = getattr(error, "strerror", None) or one_line(error)
        raise InputError(f"{path}: cannot be written ({reason})") from error
    _check_memory(film, channels)


@contextlib.contextmanager
def _of_one_pixel(film: mi.Film) -> Iterator[None]:
    """A context in which a film has a crop window of one pixel. The film's contents are lost."""
    import mitsuba as mi

    parameters, keys = mi.traverse(film), ("crop_size", "crop_offset")
    window = [list(map(int, x)) for x in (film.crop_size(), film.crop_offset())]

    def crop(*window: list[int]) -> None:
        for key, value in zip(keys, window):
            parameters[key] = value
        parameters.update()

    if not all(key in parameters for key in keys):  # a film from another package
        yield
        return
    crop([1, 1], [0, 0])
    try:
        yield
    finally:
        crop(*window)


def _check_memory(film: mi.Film, channels: int) -> None:
    width, height = film.crop_size()
    # For the film, its image, and the random numbers of a sample
    needed, memory = int(width) * int(height) * (4 * 2 * channels + 16), memory_bytes()
    if memory and needed > memory:
        raise InputError(
            f"a film of {width}x{height} pixels with {channels} channels needs at least "
            f"{needed / 2**30:.0f} GiB, and this machine has {memory / 2**30:.0f}: choose a "
            f"smaller --size, or render crop windows"
        )


def count_non_finite(film: mi.Film) -> tuple[int, int]:
    """The number of pixels of a film's image (without AOVs) that are NaN or infinite, and the
    number of all pixels."""
    image = np.array(film.develop())[..., : film.base_channels_count()]
    bad = ~np.isfinite(image).all(axis=2)
    return int(np.count_nonzero(bad)), bad.size


def write_film(
    path: Path,
    film: mi.Film,
    metadata: Mapping[str, object],
    others: Mapping[str, np.ndarray] | None = None,
    is_compressed: bool = True,
) -> None:
    """Writes the image of a film: all channels and ``others`` (arrays of shape (height, width)) to
    an EXR, RGB to HDR and PFM, 8-bit sRGB to the other formats."""
    if path.suffix.lower() == ".exr" and not is_compressed:
        write_exr_fast(path, _planes(film, others or {}), metadata)
    else:
        _save(_bitmap(path, film, metadata, others or {}), path)


def _bitmap(
    path: Path, film: mi.Film, metadata: Mapping[str, object], others: Mapping[str, np.ndarray]
) -> mi.Bitmap:
    """The bitmap that :func:`write_film` writes."""
    import mitsuba as mi

    if path.suffix.lower() == ".exr":
        planes = _planes(film, others)
        return _exr(np.stack(list(planes.values()), axis=2), list(planes), metadata)
    bitmap = film.bitmap()
    if bitmap.pixel_format() == mi.Bitmap.PixelFormat.MultiChannel:
        bitmap = bitmap.split()[0][1]  # the image without its AOVs
    return _converted(bitmap, path)


def _planes(film: mi.Film, others: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
    # The film's own bitmap may have half precision
    pixels = np.moveaxis(np.array(film.develop()), 2, 0)
    names = [entry.name for entry in film.bitmap().struct_()]
    return {**dict(zip(names, pixels)), **others}


def write_rgb(path: Path, pixels: np.ndarray, metadata: Mapping[str, object]) -> None:
    """Writes linear RGB, (height, width, 3), like :func:`write_film`."""
    import mitsuba as mi

    if path.suffix.lower() == ".exr":
        write_exr(path, pixels, "RGB", metadata)
    else:
        pixels = np.ascontiguousarray(pixels, dtype=np.float32)
        _save(_converted(mi.Bitmap(pixels, mi.Bitmap.PixelFormat.RGB), path), path)


def _converted(bitmap: mi.Bitmap, path: Path) -> mi.Bitmap:
    """RGB in the number format of the file."""
    import mitsuba as mi

    eight_bit = path.suffix.lower() not in (".hdr", ".pfm")
    component = mi.Struct.Type.UInt8 if eight_bit else mi.Struct.Type.Float32
    return bitmap.convert(mi.Bitmap.PixelFormat.RGB, component, eight_bit)


def to_rgb(image: object, channels: Sequence[str]) -> np.ndarray:
    """Converts a rendered tensor to an array (height, width, 3): alpha and AOVs are dropped, grey
    is repeated.

    Args:
        image: The tensor; its first channels are the channels of the film's image.
        channels: The names of its channels, from :func:`film_channels`.
    """
    pixels = np.array(image, dtype=np.float32)
    if channels[0] == "Y":
        return np.repeat(pixels[:, :, :1], 3, axis=2)
    return pixels[:, :, :3]


def check_comparable(film: mi.Film) -> None:
    """Raises :class:`InputError` for a film whose image has no RGB (or grey) channels."""
    import mitsuba as mi

    if mi.has_flag(film.flags(), mi.FilmFlags.Special):
        raise InputError(
            f'the film "{film.class_name()}" has no RGB image to compare: use an "hdrfilm"'
        )
    film.prepare([])
    if film_channels(film)[0] == "X":
        raise InputError('the film\'s "pixel_format" is "xyz": only "rgb" can be compared')


def film_channels(film: mi.Film) -> list[str]:
    """The names of the channels of a film that has been rendered to (or prepared)."""
    return [field.name for field in film.bitmap().struct_()]


def _save(bitmap: mi.Bitmap, path: Path) -> None:
    # Encoded in memory first: on a full disk, Mitsuba 3.9.1 leaves half a file and raises no error
    content = _encoded(bitmap, path)
    with replacing(path) as temporary:
        temporary.write_bytes(content)


def _encoded(bitmap: mi.Bitmap, path: Path) -> bytes:
    """The contents of a file in the format of ``path``."""
    import mitsuba as mi

    stream, kind = mi.MemoryStream(), _FORMATS.get(path.suffix.lower(), "OpenEXR")
    try:
        bitmap.write(stream, getattr(mi.Bitmap.FileFormat, kind))
    except RuntimeError as error:
        raise OSError(f"{path}: {one_line(error)}") from error
    return stream.raw_buffer()


def _attribute(value: object) -> str | float | int:
    """A value for the header of an EXR: text and numbers unchanged, everything else as JSON."""
    plain = isinstance(value, (str, float)) or (
        isinstance(value, int) and not isinstance(value, bool) and abs(value) < 2**31
    )
    return value if plain else json.dumps(value)
