"""The state of a render in batches: the list of the batches, and the sum of their images."""

from __future__ import annotations

import json
from typing import NamedTuple

import mitsuba as mi
import numpy as np

from ..images.coverage import Coverage
from ..rendering.batches import Batches
from ..rendering.film_sums import FilmSums
from ..rendering.totals import RenderTotals
from ..util.errors import InputError
from ..util.stored_arrays import StoredArrays


class Batch(NamedTuple):
    """A part of a render.

    Attributes:
        seed: The seed of the render.
        index: The index of the batch among the batches of this seed.
        spp: The samples per pixel of the batch.
    """

    seed: int
    index: int
    spp: int


class BatchResult(NamedTuple):
    """The result of a batch.

    Attributes:
        batch: The batch.
        contents, has_weights: The data of :class:`~mitsuba_ext.rendering.film_sums.FilmSums`.
        image: The developed film with its AOVs: [height, width, channel].
        channels, image_channel_count: As in :class:`~mitsuba_ext.rendering.batches.Batches`.
        aov_names: The channels besides the image's.
        learned: The file that the integrator's ``save_learned`` writes, for the other batches;
            empty if there was nothing to learn, ``None`` if the batch did not have to learn.
        totals: The cost of the batch.
        coverage: What covers each pixel, if the integrator has masks.
    """

    batch: Batch
    contents: np.ndarray
    has_weights: bool
    image: np.ndarray
    channels: tuple[str, ...]
    image_channel_count: int
    aov_names: tuple[str, ...]
    totals: RenderTotals
    learned: bytes | None = None
    coverage: Coverage | None = None


def image_shape(film: mi.Film) -> tuple[int, int]:
    """The height and the width of a film's image."""
    width, height = film.crop_size()
    return int(height), int(width)


class RenderState:
    """Sums over batches. Each batch adds only 12 bytes to the size of the state.

    Attributes:
        done: The batches, in the order in which they were added.
        film: The sum of the contents of their films.
        images: The mean and variance of their images; ``None`` before the first batch.
        aov_names: The channels besides the image's.
        learned: The state that a batch learned for the others, as in :class:`BatchResult`.
        totals: The total cost of the batches.
        coverage: What covers each pixel, if the integrator has masks.
    """

    def __init__(self) -> None:
        self.done: list[Batch] = []
        self.learned: bytes | None = None
        self.totals = RenderTotals()
        self.film, self.images = FilmSums(), None
        self.aov_names: tuple[str, ...] = ()
        self.coverage: Coverage | None = None

    @property
    def spp(self) -> int:
        """The samples per pixel of all batches together."""
        return self.film.spp

    def add(self, result: BatchResult) -> None:
        """Adds a batch.

        Raises:
            InputError: The image's size or channels differ from the previous batches.
        """
        before = self.images
        if before and (before.mean.shape, before.channels) != (result.image.shape, result.channels):
            raise InputError(
                f"a batch has an image of shape {result.image.shape} ({' '.join(result.channels)}) "
                f"instead of {before.mean.shape} ({' '.join(before.channels)})"
            )
        images = self.images or Batches(result.channels, result.image_channel_count)
        images.add(result.image, result.batch.spp)
        film = FilmSums()
        film.contents, film.has_weights = result.contents.astype(np.float64), result.has_weights
        film.spp = result.batch.spp
        self.film = self.film.plus(film)
        self.images, self.aov_names = images, result.aov_names
        self.coverage = _both(self.coverage, result.coverage)
        self.done.append(result.batch)
        if result.learned is not None:
            self.learned = result.learned
        self.totals = self.totals.plus(result.totals)

    def plus(self, other: RenderState) -> RenderState:
        """The merged state, with the batches of both.

        Raises:
            InputError: Both states contain the same batch, or their channels differ.
        """
        shared = {batch[:2] for batch in self.done} & {batch[:2] for batch in other.done}
        if shared:
            seed = min(shared)[0]
            raise InputError(f"both have samples of seed {seed}: render one with another --seed")
        if self.images is None or other.images is None:
            return other if self.images is None else self
        if self.images.channels != other.images.channels:
            raise InputError("they have different channels")
        shapes = {np.shape(state.film.contents) for state in (self, other)}
        if len(shapes) > 1 or self.images.mean.shape != other.images.mean.shape:
            raise InputError("they have different sizes")
        total = RenderState()
        total.done = [*self.done, *other.done]
        total.film, total.images = self.film.plus(other.film), self.images.plus(other.images)
        total.aov_names = self.aov_names
        total.coverage = _both(self.coverage, other.coverage)
        total.totals = self.totals.plus(other.totals)
        return total

    def fill(self, film: mi.Film) -> None:
        """Replaces the contents of a film with the image of all batches."""
        self.film.fill(film, self.aov_names)

    def fits(self, film: mi.Film) -> bool:
        """Whether the images fit a film with these channels. If so, fills the film."""
        if not self.done:
            return True
        if self.images.mean.shape[:2] != image_shape(film):
            return False
        try:
            self.fill(film)
        except (RuntimeError, TypeError):  # the number of channels differs
            return False
        return film.base_channels_count() + len(self.aov_names) == len(self.images.channels)

    # ---- As arrays ----

    def arrays(self) -> dict[str, np.ndarray]:
        """The state as arrays, for :meth:`from_arrays`."""
        images = self.images.arrays() if self.images else {}
        learned = {}
        if self.learned is not None:
            learned["learned"] = np.frombuffer(self.learned, dtype=np.uint8)
        coverage = self.coverage.arrays() if self.coverage else {}
        return {
            **{f"coverage.{name}": array for name, array in coverage.items()},
            **{f"images.{name}": array for name, array in images.items()},
            **learned,
            "done": np.array(self.done, dtype=np.uint32).reshape(-1, 3),
            "contents": np.asarray(self.film.contents),
            "has_weights": np.array(self.film.has_weights),
            "spp": np.array(self.film.spp),
            "totals": np.array(json.dumps(self.totals.known())),
            "aov_names": np.array(self.aov_names, dtype=str),
        }

    @classmethod
    def from_arrays(cls, arrays: StoredArrays, most_bytes: int) -> RenderState:
        """The inverse of :meth:`arrays`.

        Args:
            most_bytes: The maximum size of an array, in bytes.

        Raises:
            DamagedError: The arrays are not a state.
        """
        state, anything = cls(), (-np.inf, np.inf)
        done = arrays.take("done", "u", (None, 3), 0, 0xFFFFFFFF, most_bytes)
        state.done = [Batch(*row) for row in done.tolist()]
        indices = {(seed, index) for seed, index, _spp in state.done}
        arrays.require(len(indices) == len(done), "a batch is there twice")
        spp = int(done[:, 2].sum(dtype=np.uint64))
        arrays.number("spp", "iu", spp, spp)
        state.totals = RenderTotals.of_known(arrays.text("totals", most_bytes), arrays)
        state.aov_names = arrays.texts("aov_names")
        if "learned" in arrays:
            state.learned = arrays.take("learned", "u", (None,), 0, 0xFF, most_bytes).tobytes()
        if not state.done:
            return state
        state.images = Batches.from_arrays(arrays.part("images."), most_bytes)
        arrays.require(
            state.images.count == len(done) and state.images.spp == spp,
            f"images of {state.images.count} batches, and {len(done)} batches",
        )
        shape = (*state.images.mean.shape[:2], None)
        state.film.contents = arrays.take("contents", "f", shape, *anything, most_bytes)
        state.film.has_weights = bool(arrays.take("has_weights", "b"))
        state.film.spp = spp
        if "coverage.size" in arrays:
            state.coverage = Coverage.from_arrays(arrays.part("coverage."), most_bytes)
            is_same = state.coverage.size == (shape[1], shape[0])
            arrays.require(is_same, f"masks of the size {state.coverage.size}")
        return state


def _both(first: Coverage | None, second: Coverage | None) -> Coverage | None:
    """The sum of what there is."""
    return first.plus(second) if first and second else first or second
