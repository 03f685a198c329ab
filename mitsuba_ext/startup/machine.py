"""The software versions and the machine on which a measurement depends."""

from __future__ import annotations

import os
import platform

from ..util.version import __version__


def versions() -> dict[str, str]:
    """The versions of the software on which images depend, and the active variant."""
    import drjit
    import mitsuba
    import numpy

    return {
        "mitsuba_ext": __version__,
        "mitsuba": mitsuba.__version__,
        "drjit": drjit.__version__,
        "variant": mitsuba.variant() or "",
        "numpy": numpy.__version__,
        "python": platform.python_version(),
    }


def machine() -> dict[str, object]:
    """System, processor and number of cores."""
    return {
        "system": platform.platform(),
        "processor": _processor(),
        "cores": _core_count(),
    }


def memory_bytes() -> int | None:
    """The memory of this machine; ``None`` if unknown."""
    try:
        return os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
    except (AttributeError, ValueError, OSError):
        return None  # Windows


def _core_count() -> int | None:
    try:
        return len(os.sched_getaffinity(0))  # what this process may use
    except AttributeError:
        return os.cpu_count()  # not Linux


def _processor() -> str:
    try:
        with open("/proc/cpuinfo", encoding="utf-8") as file:
            for line in file:
                if line.startswith("model name"):
                    return line.partition(":")[2].strip()
    except OSError:
        pass  # not Linux
    return platform.processor() or platform.machine()
