"""Light transport techniques for Mitsuba 3 that its own ``path`` lacks.

``import mitsuba_ext`` registers every plugin in the active variant and in every variant that is
selected later. Scenes then name the plugins as they name Mitsuba's own::

    import mitsuba as mi
    import mitsuba_ext
    mi.set_variant("llvm_ad_rgb")
    scene = mi.load_file("scene.xml")
    image = mi.render(scene, integrator=mi.load_dict({"type": "auto"}))

``mitsuba_ext.compare`` measures the speed and the error of integrators.
"""

from importlib import import_module
from pathlib import Path

from .startup import mitsuba_import
from .util.version import __version__

__all__ = ["__version__"]

#: Public modules, which are imported when they are first used: they import Mitsuba.
_MODULES = ("compare", "replay", "scene_description")

# An installed package contains the folders of plugins. In the source tree they are beside it.
_folder = Path(__file__).parent
if not (_folder / "integrators").is_dir():
    if not (_folder.parent / "integrators").is_dir():
        raise ImportError(
            f"mitsuba_ext finds none of its plugins: {_folder} must be a folder that `pip install` "
            "made, or the folder of the sources (not inside of a zip archive)."
        )
    __path__.append(str(_folder.parent))

mitsuba_import.prepare()


def __getattr__(name: str) -> object:
    if name in _MODULES:
        return import_module(f".{name}", __name__)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


def __dir__() -> list[str]:
    """The public names. The page of the Python API names a few functions of other modules."""
    return sorted({*__all__, *_MODULES, *(name for name in globals() if name.startswith("__"))})
