"""How much memory this process may use: memory of the machine, and of a GPU."""

from __future__ import annotations

import ctypes
import os
from dataclasses import dataclass
from pathlib import Path

try:
    import resource
except ImportError:  # Windows
    resource = None


@dataclass(frozen=True)
class Memory:
    """
    Attributes:
        total: Bytes that this process may use in all.
        free: Bytes of them that are not in use.
    """

    total: int
    free: int


def machine_memory(root: Path = Path("/")) -> Memory | None:
    """The memory of the machine, or less where a control group (of a container or a batch system)
    or ``ulimit -v`` limits it; ``None`` if the system does not tell.

    Parameters:
        root: The folder with ``proc`` and ``sys``.
    """
    found = [_machine(root), *_control_groups(root), _address_space(root)]
    known = [memory for memory in found if memory is not None]
    if not known:
        return None
    return Memory(min(each.total for each in known), max(0, min(each.free for each in known)))


def gpu_memory(cuda: ctypes.CDLL | None = None) -> Memory | None:
    """The memory of the first GPU, which Dr.Jit renders on; ``None`` if the driver does not tell.

    Parameters:
        cuda: The library of the driver.
    """
    context, free, total = ctypes.c_void_p(), ctypes.c_size_t(), ctypes.c_size_t()
    try:
        if cuda is None:
            cuda = ctypes.CDLL("nvcuda.dll" if os.name == "nt" else "libcuda.so.1")
        # Dr.Jit uses this context, but makes it current only while it calls the driver
        if cuda.cuDevicePrimaryCtxRetain(ctypes.byref(context), 0) != 0:
            return None
        try:
            if cuda.cuCtxPushCurrent_v2(context) != 0:
                return None
            failed = cuda.cuMemGetInfo_v2(ctypes.byref(free), ctypes.byref(total))
            cuda.cuCtxPopCurrent_v2(ctypes.byref(context))
        finally:
            cuda.cuDevicePrimaryCtxRelease_v2(0)
    except (OSError, AttributeError):
        return None
    return None if failed else Memory(total.value, free.value)


def _machine(root: Path) -> Memory | None:
    lines = _read(root / "proc/meminfo").splitlines()
    found = {line.split(":")[0]: line.split()[1] for line in lines if ":" in line}
    if "MemTotal" in found:
        total = int(found["MemTotal"])
        return Memory(1024 * total, 1024 * int(found.get("MemAvailable", total)))
    try:  # macOS
        total = os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")
    except (AttributeError, OSError, ValueError):
        return None
    return Memory(total, total)


def _control_groups(root: Path) -> list[Memory]:
    """The limits of the groups of this process, from the innermost group to the outermost."""
    found = []
    for line in _read(root / "proc/self/cgroup").splitlines():
        number, controllers, path = line.split(":", 2)
        if number == "0":
            top, cached = "sys/fs/cgroup", "inactive_file"
            names = ("memory.max", "memory.current")
        elif "memory" in controllers.split(","):
            top, cached = "sys/fs/cgroup/memory", "total_inactive_file"
            names = ("memory.limit_in_bytes", "memory.usage_in_bytes")
        else:
            continue
        # In a container, the path may be a path of the host, whose inner folders are not there
        inner = Path(path.lstrip("/"))
        for folder in (root / top / each for each in (inner, *inner.parents)):
            limit, used = (_read(folder / name).strip() for name in names)
            if not (limit.isdigit() and used.isdigit()):
                continue
            # The system drops cached files where memory is needed
            stat = dict(line.split()[:2] for line in _read(folder / "memory.stat").splitlines())
            free = int(limit) - int(used) + int(stat.get(cached, 0))
            found.append(Memory(int(limit), free))
    return found


def _address_space(root: Path) -> Memory | None:
    if resource is None:
        return None
    limit = resource.getrlimit(resource.RLIMIT_AS)[0]
    pages = _read(root / "proc/self/statm").split()
    if limit == resource.RLIM_INFINITY or not pages:
        return None
    return Memory(limit, limit - int(pages[0]) * os.sysconf("SC_PAGE_SIZE"))


def _read(file: Path) -> str:
    """The text of a file; empty if it cannot be read."""
    try:
        return file.read_text(encoding="utf-8")
    except OSError:
        return ""
