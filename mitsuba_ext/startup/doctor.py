"""Prints the report of ``mitsuba-ext doctor``: versions, hardware, LLVM, plugins, tiny renders.

Each part is independent: if one fails, it prints why, and the other parts follow. The renders run
in another process, because an unusable backend crashes without an exception.
"""

from __future__ import annotations

import json
import os
import platform
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from importlib import metadata
from pathlib import Path
from typing import TYPE_CHECKING

from ..util.version import __version__
from . import llvm, runtime
from .processes import python_command

if TYPE_CHECKING:
    import mitsuba as mi

#: The time limit of all renders, in seconds; the remaining plugins are not tried.
RENDER_BUDGET = 120.0


def main(variant: str | None = None) -> int:
    """Prints the report.

    Args:
        variant: The variant to render in. By default, the active one, otherwise the first supported
            one whose backend works here.

    Returns:
        The exit code of the command: 0 if everything works, 1 if a part failed.
    """
    parts: list[tuple[str, Callable[[], Iterator[str]]]] = [
        ("Versions", _versions),
        ("Machine", _machine),
        ("LLVM", _llvm),
        ("Variants", _variants),
        ("Plugins", _plugins),
        ("Tiny renders", lambda: tiny_renders(variant or _default_variant())),
    ]
    healthy = True
    for title, part in parts:
        print(title, flush=True)
        try:
            for line in part():
                healthy &= not line.startswith("!")
                print("  " + line, flush=True)
        except Exception as error:  # a part may raise anything; the others follow
            healthy = False
            print(f"  ! {type(error).__name__}: {error}", flush=True)
    print("Everything works." if healthy else "Lines that start with ! need attention.")
    return 0 if healthy else 1


def _versions() -> Iterator[str]:
    yield f"mitsuba_ext {__version__} ({Path(__file__).parents[1]})"
    for name in ("mitsuba", "drjit", "numpy", "OpenEXR"):
        try:
            yield f"{name} {metadata.version(name)}"
        except metadata.PackageNotFoundError:
            yield f"{name}: no package metadata (built from source?)"
    yield f"Python {platform.python_version()} ({sys.executable})"
    yield platform.platform()


def _machine() -> Iterator[str]:
    model, flags = llvm.cpu()
    features = [name for name in ("avx2", "fma", "avx512f", "avx512vl", "asimd") if name in flags]
    yield f"CPU: {model} ({' '.join(features) or 'features unknown'})"
    allowed = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count()
    yield f"cores: {os.cpu_count()}, usable by this process: {allowed}"
    gibibyte = 2**30
    total = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") / gibibyte
    yield f"memory: {total:.1f} GiB"
    limit = Path("/sys/fs/cgroup/memory.max")
    if limit.exists() and limit.read_text().strip() != "max":
        yield f"memory limit of the control group: {int(limit.read_text()) / gibibyte:.1f} GiB"
    yield from _gpus()


def _gpus() -> Iterator[str]:
    if not shutil.which("nvidia-smi"):
        yield "GPU: none (there is no nvidia-smi)"
        return
    command = [
        "nvidia-smi",
        "--query-gpu=name,memory.total,driver_version",
        "--format=csv,noheader",
    ]
    answer = subprocess.run(command, capture_output=True, text=True, timeout=30)
    for line in (answer.stdout if answer.returncode == 0 else answer.stderr).splitlines():
        yield f"GPU: {line}"


def _llvm() -> Iterator[str]:
    default = llvm.default_library()
    chosen_by = f"{llvm.VARIABLE} = " if os.environ.get(llvm.VARIABLE) else "Dr.Jit's own choice: "
    yield f"{chosen_by}{default or 'none'}"
    if "drjit" in sys.modules:
        yield f"loaded: {runtime.loaded_library() or 'none'}"
    for library in llvm.candidates():
        yield f"found {library}: {llvm.fault(library) or 'usable'}"
    problem = runtime.llvm_problem()
    if problem:
        # A machine with a GPU does not need LLVM, so this alone is not a failure there
        yield problem if _has_cuda() else f"! {problem}"


def _variants() -> Iterator[str]:
    import mitsuba as mi

    yield f"active: {mi.variant() or 'none'}"
    yield f"supported: {', '.join(runtime.SUPPORTED_VARIANTS)}"
    yield f"CUDA backend: {'available' if _has_cuda() else 'not available'}"


def _has_cuda() -> bool:
    import drjit as dr

    return bool(dr.has_backend(dr.JitBackend.CUDA))


def _default_variant() -> str:
    import mitsuba as mi

    if mi.variant() in runtime.SUPPORTED_VARIANTS:
        return str(mi.variant())
    return "cuda_ad_rgb" if runtime.llvm_problem() and _has_cuda() else "llvm_ad_rgb"


def _plugins() -> Iterator[str]:
    from .registry import plugin_names

    for kind, names in plugin_names().items():
        yield f"{kind}: {', '.join(names) or 'none'}"


def tiny_renders(variant: str) -> Iterator[str]:
    """One line per integrator. If an integrator crashes, a new process renders the rest.
    """
    from .registry import plugin_names

    runtime.check(variant)
    yield f"a 32 x 32 Cornell box, 16 spp, {variant}, default parameters"
    names = ["path", *plugin_names()["integrators"]]
    deadline = time.monotonic() + RENDER_BUDGET
    while names:
        if time.monotonic() > deadline:
            yield f"not tried for lack of time: {', '.join(names)}"
            return
        for result in _render_elsewhere(variant, names, deadline - time.monotonic()):
            names.remove(result["name"])
            yield _line(result)


def _line(result: dict) -> str:
    if "refused" in result:  # not a failure: for example, it needs a spectral variant
        return f"{result['name']}: not tried: {result['refused']}"
    if "error" in result:
        return f"! {result['name']}: {result['error']}"
    mark = "" if result["finite"] else "! not finite: "
    return f"{mark}{result['label']}: mean {result['mean']:.4f}, {result['seconds']:.2f} s"


def _render_elsewhere(variant: str, names: list[str], timeout: float) -> list[dict]:
    """Results for ``names``, in order, up to the first integrator that crashes."""
    command = python_command("mitsuba_ext.startup.doctor", variant, *names)
    with tempfile.TemporaryFile("w+") as out, tempfile.TemporaryFile("w+") as err:
        try:
            code = subprocess.run(command, stdout=out, stderr=err, timeout=timeout).returncode
            reason = f"its process ended with {_exit_name(code)}"
        except subprocess.TimeoutExpired:
            code, reason = 1, f"not done within {timeout:.0f} s"
        out.seek(0)
        err.seek(0)
        lines = [line for line in out.read().splitlines() if line.startswith("{")]
        results = [json.loads(line) for line in lines]
        last_words = err.read().strip().splitlines()[-1:]
    if len(results) < len(names):
        error = ": ".join([reason, *last_words])
        results.append({"name": names[len(results)], "error": error})
    return results


def _exit_name(code: int) -> str:
    return signal.Signals(-code).name if code < 0 else f"exit code {code}"


def _render_here(variant: str, names: list[str]) -> None:
    """Prints one line of JSON for each integrator."""
    import drjit as dr
    import mitsuba as mi
    import numpy as np

    mi.set_variant(variant)
    mi.set_log_level(mi.LogLevel.Error)  # keeps warnings out of stdout, which holds the results
    description = mi.cornell_box()
    description["sensor"]["film"].update(width=32, height=32)
    # Some integrators need a lens
    description["sensor"].update(type="thinlens", aperture_radius=0.01, focus_distance=3.9)
    scene = mi.load_dict(description)
    for name in names:
        result: dict = {"name": name}
        try:
            result["label"], integrator = _make(name)
        except Exception as error:
            result["refused"] = str(error).strip().splitlines()[0]
            print(json.dumps(result), flush=True)
            continue
        try:
            start = time.perf_counter()
            image = mi.render(scene, integrator=integrator, spp=16, seed=0)
            dr.eval(image)
            pixels = np.array(image)
            result["seconds"] = time.perf_counter() - start
            result["finite"] = bool(np.isfinite(pixels).all())
            result["mean"] = float(pixels[..., :3].mean())
        except Exception as error:
            result["error"] = f"{type(error).__name__}: {error}"
        print(json.dumps(result), flush=True)


def _make(name: str) -> tuple[str, mi.Integrator]:
    """A label and the integrator with default parameters. If it needs a nested integrator, it gets
    ``composed_path``."""
    import mitsuba as mi

    manager = mi.PluginManager.instance()
    try:
        return name, manager.create_object(mi.Properties(name))
    except Exception:  # a plugin's constructor may raise anything
        properties = mi.Properties(name)
        properties["nested"] = manager.create_object(mi.Properties("composed_path"))
        return f"{name} around composed_path", manager.create_object(properties)


if __name__ == "__main__":
    _render_here(sys.argv[1], sys.argv[2:])
