"""Renders the references of comparisons in worker processes."""

from __future__ import annotations

from collections.abc import Iterator
from concurrent.futures import Executor

import mitsuba as mi

from ..inputs.chosen import Chosen, LastScene
from ..inputs.scenes import LoadedScene
from ..rendering.batches import Batches
from ..util.errors import InputError
from .batch_renderer import BatchRenderer, RenderRequest
from .dispatch import Dispatch
from .state import Batch


class ReferenceWorkers:
    """The workers that render the references of a comparison. They do not render the measured runs,
    because times on different machines or on shared cores are not comparable.

    Parameters:
        executor: The executor that runs the workers; see
            :class:`~mitsuba_ext.long_renders.dispatch.Dispatch`.
        count: The number of batches that it renders at a time.
        plugins: Modules that register other plugins.
        threads: The number of threads of each process; 0 for the number of cores.
    """

    def __init__(
        self, executor: Executor, count: int = 1, plugins: tuple[str, ...] = (), threads: int = 0
    ) -> None:
        if not callable(getattr(executor, "submit", None)):
            raise InputError(f"an executor must have a method submit(), found {executor!r}")
        self._executor, self._count = executor, count
        self._plugins, self._threads = plugins, threads

    def batches(
        self,
        scene: LoadedScene,
        specification: object,
        seed: int,
        count: int,
        spp: int,
        batches: Batches | None,
    ) -> Iterator[Batches]:
        """Yields the sum of all batches so far after each batch, like
        :func:`~mitsuba_ext.rendering.batches.each_batch`.

        Args:
            scene: The scene, from a file.
            specification: The integrator, as text.
            seed: The seed of the reference.
            count, spp: The number of batches, including ``batches``, and the samples per pixel of
                each.
            batches: The first batches if already rendered; otherwise ``None``.

        Raises:
            InputError: The scene or the integrator cannot be sent, or a batch fails.
        """
        if scene.path is None or not isinstance(specification, str):
            raise InputError(
                "cannot be sent to others: for an executor, the scene must be a file, and the "
                "reference's integrator must be given as text"
            )
        film = scene.scene.sensors()[0].film()
        changes = scene.changes
        has_crop_window = tuple(film.crop_size()) != tuple(film.size()) and not changes.crop
        request = RenderRequest(
            str(scene.path), None if has_crop_window else tuple(map(int, film.size())),
            tuple(scene.parameters.items()), specification, seed=seed, variant=mi.variant(),
            plugins=self._plugins, threads=self._threads, changes=changes,
        )  # fmt: skip
        renderer = BatchRenderer(request, scenes=_Loaded(scene))
        dispatch = Dispatch(self._executor, renderer, lambda: self._count)
        index = batches.count if batches else 0
        waiting = (Batch(seed, number, spp) for number in range(index, count))
        # Added in the order of their indices, because an interrupted reference continues after the
        # first ``batches.count``
        early = {}
        for result in dispatch.results(waiting, lambda: b"", lambda: False):
            early[result.batch.index] = result
            while result := early.pop(index, None):
                batches = batches or Batches(result.channels, result.image_channel_count)
                batches.add(result.image, result.batch.spp)
                index += 1
                yield batches


class _Loaded(LastScene):
    """Returns a scene that is already loaded."""

    def __init__(self, loaded: LoadedScene) -> None:
        self._given = loaded

    def choose(self, path, size, definitions, specification, sensor_index, *_others) -> Chosen:
        return Chosen.of(self._given, specification, sensor_index)
