"""Light transport techniques for Mitsuba 3 that its own ``path`` lacks.

``import mitsuba_ext`` registers every plugin in the active variant and in every variant that is
selected later. Scenes then name the plugins as they name Mitsuba's own::

    import mitsuba as mi
    import mitsuba_ext
    mi.set_variant("llvm_ad_rgb")
    image = mi.render(mi.load_file("scenes/door_ajar.xml", integrator="neepp"))
"""

from . import runtime

runtime.prepare()  # chooses the LLVM library, so it must come before the first import of drjit

import mitsuba  # noqa: E402

from . import registry  # noqa: E402

runtime.guard(mitsuba)
registry.install()

__version__ = "0.1.0"

__all__ = ["__version__"]
