"""Light transport techniques for Mitsuba 3 that its own ``path`` lacks.

``import mitsuba_ext`` registers every plugin in the active variant and in every variant that is
selected later. Scenes then name the plugins as they name Mitsuba's own::

    import mitsuba as mi
    import mitsuba_ext
    mi.set_variant("llvm_ad_rgb")
    scene = mi.load_file("scene.xml")
    image = mi.render(scene, integrator=mi.load_dict({"type": "auto"}))
"""

from pathlib import Path

from .startup import mitsuba_import

__version__ = "0.2.0"

__all__ = ["__version__"]

# An installed package contains the folders of plugins. In the source tree they are beside it.
_folder = Path(__file__).parent
if not (_folder / "integrators").is_dir():
    if not (_folder.parent / "integrators").is_dir():
        raise ImportError(
            f"mitsuba_ext finds none of its plugins: {_folder} must be a folder that `pip install` "
            "made, or that of the sources (not inside of a zip archive)."
        )
    __path__.append(str(_folder.parent))

mitsuba_import.prepare()
