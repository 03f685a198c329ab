"""How often a pass of light paths launches something on the device, and reads from it."""

from __future__ import annotations

from collections import Counter

import drjit as dr
import mitsuba as mi
import pytest

from mitsuba_ext.rendering.render import Job
from tests.support.statistical import load

pytestmark = pytest.mark.usefixtures("variant")

#: What Dr.Jit launches besides kernels to clear and to fill memory. (Tables of the functions that
#: are called are copied by "Aggregate".)
OTHER = "Aggregate", "Memset"


def launches(name: str, size: int, max_depth: int) -> Counter[str]:
    """The launches of the last pass of a render with two passes, when kernels are recorded."""
    scene = load("cornell_box", width=size, height=size)
    integrator, found = mi.load_dict({"type": name, "max_depth": max_depth}), []
    integrator.samples_per_pass = 4
    run_pass = Job.run_pass

    def counted(self, *arguments):
        dr.kernel_history_clear()
        result = run_pass(self, *arguments)
        found.append(Counter(k["type"].name for k in dr.kernel_history()))
        return result

    mi.render(scene, integrator=integrator, spp=8)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(Job, "run_pass", counted)
        with dr.scoped_set_flag(dr.JitFlag.KernelHistory, True):
            mi.render(scene, integrator=integrator, spp=8, seed=1)
    assert len(found) == 2
    return found[1]


@pytest.mark.parametrize(
    ("name", "depth", "kernels", "all_launches"),
    [("bdpt", 8, 9, 20), ("bdpt", -1, 21, 40), ("vcm", 8, 9, 20), ("sppm", 8, 12, 24),
     ("light_tracer", 8, 9, 20)],
)  # fmt: skip
def test_a_pass_launches_few_kernels(
    name: str, depth: int, kernels: int, all_launches: int
) -> None:
    found = launches(name, 32, depth)
    assert 0 < found["JIT"] <= kernels, found
    assert sum(found.values()) - sum(found[k] for k in OTHER) <= all_launches, found


def test_larger_films_need_no_more_launches() -> None:
    small, large = (launches("bdpt", size, 8) for size in (32, 64))
    assert small["JIT"] == large["JIT"] > 0 and small["Memcpy"] == large["Memcpy"] > 0
