"""Light maps as arrays: they find their lights again, and damaged ones are refused."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from mitsuba_ext.scene.fingerprint import digest, fingerprint
from mitsuba_ext.scene.lights.division import emitter_shapes
from mitsuba_ext.techniques.learned_lights.light_map_arrays import arrays_of, of_arrays
from mitsuba_ext.util.stored_arrays import DamagedError, StoredArrays
from tests.support.maps import floor, lamp, map_of

pytestmark = pytest.mark.usefixtures("variant")

MEMORY = 2**26


def _scene(*order: str) -> mi.Scene:
    """Divided lights, twins, and an environment, listed in some order."""
    lights = {
        "wide": lamp(0, 0, 1, size=0.8),
        "long": {"type": "cylinder", "p0": [-1, 1, 1], "p1": [1, 1, 1], "radius": 0.1,
                 "emitter": {"type": "area"}},
        "twin": lamp(0.5, 0, 1),
        "other twin": lamp(0.5, 0, 1),
        "point": {"type": "point", "position": [0, 0, 2]},
        "sky": {"type": "constant"},
    }  # fmt: skip
    return floor(**{name: lights[name] for name in order or lights})


def _numbered(scene: mi.Scene):
    """A map whose counts are all different."""
    light_map = map_of(scene)
    n = dr.arange(mi.UInt32, len(light_map.tests))
    light_map.restore(n + 7, n, mi.UInt64(n) * 1000)
    return light_map


def _counts(scene: mi.Scene, light_map) -> dict[bytes, np.ndarray]:
    """The counts of each light, by what it is; twins share theirs."""
    cells = light_map.cells
    tests = light_map.tests.numpy().reshape(-1, cells.count)
    counts: dict[bytes, list] = {}
    for index, (emitter, shape) in enumerate(zip(scene.emitters(), emitter_shapes(scene))):
        key = digest(shape or emitter)
        counts.setdefault(key, []).append(tests[:, cells.emitter_index == index])
    return {key: np.sort(np.concatenate(parts, axis=1)) for key, parts in counts.items()}


def test_a_map_finds_its_lights_whatever_their_order():
    scene = _scene()
    other = _scene("other twin", "point", "sky", "long", "wide", "twin")
    saved = _numbered(scene)
    assert saved.cells.count > 100
    loaded = of_arrays(StoredArrays.of(arrays_of(scene, saved)), other, MEMORY)
    assert (loaded.tests != saved.tests).numpy().any(), "the order differs"
    expected, found = _counts(scene, saved), _counts(other, loaded)
    assert expected.keys() == found.keys() and len(found) == 5
    for key, counts in expected.items():
        np.testing.assert_array_equal(found[key], counts)
    assert bool(dr.all(loaded.tests == loaded.successes + 7))
    assert bool(dr.all(loaded.squares == mi.UInt64(loaded.successes) * 1000))


def _damages(arrays: dict[str, np.ndarray]) -> dict[str, tuple[dict[str, np.ndarray], str]]:
    """Damages by name: the arrays that differ, and what the error says."""
    tests, p, bbox = arrays["tests"], arrays["p"], arrays["bbox"]
    nan = np.where(np.arange(p.shape[1]) == 3, np.nan, p).astype(np.float32)
    return {
        "short": ({"squares": arrays["squares"][:, :1]}, '"squares" has the shape'),
        "short all": ({k: arrays[k][:-1] for k in ("tests", "successes", "squares")}, "the shape"),
        "empty": ({"squares": np.zeros((0, 0), np.uint64)}, '"squares" has the shape'),
        "flat": ({"tests": tests.ravel()}, '"tests" is of type uint32 and shape'),
        "float": ({"tests": tests.astype(float)}, '"tests" is of type float64'),
        "signed": ({"tests": -tests.astype(np.int64)}, '"tests" is of type int64'),
        "large": ({"tests": tests + np.uint64(2**40)}, 'a value of "tests" is'),
        "more": ({"successes": tests + 1}, '"successes" than "tests"'),
        "bright": ({"squares": arrays["squares"] + np.uint64(2**63)}, '"squares" are too large'),
        "nan": ({"p": nan}, 'a value of "p" is nan'),
        "no points": ({"p": p[:, :0], "n": p[:, :0]}, "outside"),
        "two axes": ({"p": p[:2], "n": p[:2]}, '"p" has the shape'),
        "fewer normals": ({"n": p[:, 1:]}, '"n" has the shape'),
        "outside": ({"p": p + 100}, "outside"),
        "no box": ({"bbox": bbox[::-1]}, "no box"),
        "box of nan": ({"bbox": bbox * np.nan}, 'a value of "bbox" is nan'),
        "huge box": ({"bbox": bbox * 3e38}, 'a value of "bbox" is'),
        "box of doubles": ({"bbox": bbox.astype(float) * 1e300}, 'a value of "bbox" is'),
        "half a box": ({"bbox": bbox[:1]}, '"bbox" has the shape'),
        "coarse": ({"resolution": np.array(0)}, 'a value of "resolution" is 0'),
        "fine": ({"resolution": np.array(10**9)}, 'a value of "resolution" is 1e+09'),
        "text": ({"resolution": np.array("4")}, '"resolution" is of type'),
        "wide": ({"resolution": np.array(1000)}, 'more than the 64 of "max_memory"'),
        "other grid": ({"resolution": np.array(3)}, "has the shape"),
    }  # fmt: skip


def test_damaged_arrays_are_refused_in_one_sentence():
    scene = floor(a=lamp(0, 0, 1), b=lamp(0.5, 0, 1))
    arrays = arrays_of(scene, _numbered(scene))

    def refusal(arrays: dict[str, np.ndarray]) -> str:
        with pytest.raises(DamagedError) as caught:
            of_arrays(StoredArrays.of(arrays), scene, MEMORY)
        message = str(caught.value)
        assert "\n" not in message and message.endswith(": learn it again")
        return message

    for name, (changes, expected) in _damages(arrays).items():
        assert expected in refusal({**arrays, **changes}), name
    for key in arrays:
        others = {name: array for name, array in arrays.items() if name != key}
        assert f'without the array "{key}"' in refusal(others)
    # Other floats are none the worse
    doubles = {key: arrays[key].astype(float) for key in ("p", "n")}
    of_arrays(StoredArrays.of({**arrays, **doubles}), scene, MEMORY)


def test_a_map_of_one_voxel_is_never_too_large():
    """Learning makes it in any memory."""
    scene = floor(a=lamp(0, 0, 1))
    arrays = arrays_of(scene, map_of(scene, grid=1))
    assert of_arrays(StoredArrays.of(arrays), scene, max_memory=1).rows.resolution == 1


def test_the_fingerprint_sees_lights_and_geometry_but_no_sensor():
    def of(**more) -> str:
        return fingerprint(floor(**more))

    base = of(a=lamp(0, 0, 1))
    assert base == of(a=lamp(0, 0, 1)) == of(a=lamp(0, 0, 1), s={"type": "perspective"})
    assert len({base, of(a=lamp(0, 0, 1.01)), of(a=lamp(0, 0, 1, radiance=1.1)),
                of(a=lamp(0, 0, 1), b=lamp(0, 0, 2))}) == 4
