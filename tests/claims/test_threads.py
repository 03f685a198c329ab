"""Renders in several threads: each image agrees with a render alone, and a failure stays in its
thread."""

from __future__ import annotations

import gc
import subprocess
import sys
import threading
import time

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from mitsuba_ext.rendering.turns import in_turn
from mitsuba_ext.startup.garbage import garbage_left_alone
from tests.support.paths import ROOT
from tests.support.stage import stage

pytestmark = pytest.mark.usefixtures("variant")


def _check(shared: str, rounds: int, *names: str) -> None:
    command = [sys.executable, "-m", "tests.support.two_threads", shared, str(rounds), *names]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=280)
    assert done.returncode == 0, done.stdout + done.stderr[-2000:]


def test_images_of_two_threads_agree_with_renders_alone() -> None:
    _check("nothing", 2, "composed_path", "bdpt")


def test_images_of_two_threads_with_one_integrator_agree_with_renders_alone() -> None:
    _check("integrator", 2, "composed_path")


@pytest.mark.slow
@pytest.mark.parametrize("shared", ["nothing", "scene", "film", "integrator"])
@pytest.mark.parametrize(
    "name", ["composed_path", "auto_path", "bdpt", "vcm", "sppm", "mlt", "pssmlt", "neepp", "auto"]
)
def test_images_of_many_rounds_in_two_threads_agree_with_renders_alone(
    shared: str, name: str
) -> None:
    _check(shared, 6, name)


def _render_in_thread(integrator: mi.Integrator, scene: mi.Scene, results: list) -> None:
    def act() -> None:
        try:
            results.append(np.array(integrator.render(scene, scene.sensors()[0], spp=4)))
        except BaseException as error:
            results.append(error)

    thread = threading.Thread(target=act)
    thread.start()
    thread.join(60)
    assert not thread.is_alive(), "the render hangs"


def test_a_failed_render_does_not_break_renders_of_other_threads() -> None:
    scene = mi.load_dict(stage())
    integrator = mi.load_dict({"type": "composed_path", "max_depth": 3})
    results: list = []
    _render_in_thread(integrator, scene, results)

    def fail(done: float) -> None:
        raise KeyboardInterrupt

    integrator.progress = fail
    _render_in_thread(integrator, scene, results)
    integrator.progress = None
    _render_in_thread(integrator, scene, results)
    assert isinstance(results[1], KeyboardInterrupt)
    np.testing.assert_allclose(results[2], results[0], rtol=1e-3, atol=1e-4)


def test_renders_of_several_threads_alternate_unless_they_share_an_integrator() -> None:
    """Each render waits in its first pass for the other one to begin, if it may."""
    scene = mi.load_dict(stage())
    for are_same in (False, True):
        one = mi.load_dict({"type": "composed_path", "max_depth": 2, "samples_per_pass": 1})
        two = one if are_same else mi.load_dict(
            {"type": "composed_path", "max_depth": 2, "samples_per_pass": 1}
        )
        order: list[int] = []
        waiting = threading.Event()

        def render(number: int, integrator: mi.Integrator, order=order, waiting=waiting) -> None:
            sensor = mi.load_dict(stage()["sensor"])
            if number == 2:
                waiting.set()
            with in_turn(integrator, sensor):
                integrator.progress = lambda done: (order.append(number), waiting.wait(60))
                integrator.render(scene, sensor, spp=4)

        threads = [
            threading.Thread(target=render, args=(1, one)),
            threading.Thread(target=render, args=(2, two)),
        ]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join(60)
        assert sorted(order) == [1] * 4 + [2] * 4
        assert (order in ([1] * 4 + [2] * 4, [2] * 4 + [1] * 4)) == are_same


def test_a_render_that_waits_for_its_turn_can_be_cancelled() -> None:
    scene = mi.load_dict(stage())
    one, two = (mi.load_dict({"type": "composed_path", "max_depth": 2}) for _ in range(2))
    ended: list = []
    with in_turn(one, mi.load_dict(stage()["sensor"])):
        waiting = threading.Thread(target=lambda: ended.append(two.render(scene, spp=8)))
        two.is_cancelled = True  # an earlier render was cancelled
        waiting.start()
        while two.is_cancelled:
            time.sleep(0.001)
        two.cancel()
    waiting.join(60)
    assert ended and two.statistics.interrupted and two.statistics.spp < 8


@pytest.mark.parametrize("name", ["composed_path", "variance"])
def test_progress_may_wait_for_a_thread_that_renders_with_another_integrator(name: str) -> None:
    """The other thread has the second integrator already, and waits for its turn."""
    scene = mi.load_dict(stage())
    two, path = mi.load_dict({"type": "composed_path", "max_depth": 2}), {"type": "path"}
    one = mi.load_dict({"type": name, **({"nested": path} if name == "variance" else {})})
    ended = []

    def end(act) -> threading.Thread:
        thread = threading.Thread(target=lambda: ended.append(act()), daemon=True)
        thread.start()
        return thread

    def render(integrator: mi.Integrator) -> mi.TensorXf:
        return integrator.render(scene, mi.load_dict(stage()["sensor"]), spp=2)

    def progress(done: float) -> None:
        other = end(lambda: render(two))
        time.sleep(0.05)
        render(two)
        other.join(60)

    one.progress = progress
    end(lambda: render(one)).join(60)
    assert len(ended) == (3 if name == "variance" else 2), "the renders wait for each other"


def test_the_collector_starts_again_when_the_last_thread_allows_it() -> None:
    assert gc.isenabled()
    begun, may_end = threading.Event(), threading.Event()

    def leave_alone() -> None:
        with garbage_left_alone():
            begun.set()
            may_end.wait(60)

    thread = threading.Thread(target=leave_alone)
    with garbage_left_alone():
        thread.start()
        begun.wait(60)
    assert not gc.isenabled()
    may_end.set()
    thread.join(60)
    assert gc.isenabled()


def test_after_a_failed_pass_nothing_that_it_has_traced_waits_for_a_scene_that_is_gone() -> None:
    """Scatters waited for the next kernels: the process ended."""
    with dr.scoped_set_flag(dr.JitFlag.KernelFreezing, False):
        for _ in range(2):
            scene = mi.load_dict(stage(), optimize=False)
            parameters = mi.traverse(scene)
            key = next(k for k in parameters.keys() if k.endswith("emitter.radiance.value"))
            dr.enable_grad(parameters[key])
            parameters.update()
            integrator = mi.load_dict({"type": "auto_path", "max_depth": 3, "pilot_spp": 8})
            with pytest.raises(NotImplementedError, match="does not compute gradients"):
                integrator.render(scene, scene.sensors()[0], spp=32)
            del scene, parameters, integrator
            gc.collect()
