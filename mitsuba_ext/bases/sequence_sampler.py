"""The base class of samplers that draw points of a sequence.

This file is executed once per variant (see ``registry.py``): its base class is variant-bound.
"""

from __future__ import annotations

import drjit as dr
import mitsuba as mi

from ..startup.registry import variant_bound
from ..util.parameters import MOST_SPP, read_parameter
from ..util.sequences.pixel_order import level_count, shuffled, z_order
from ..util.sequences.scrambling import mixed
from ..util.sequences.sequence import Sequence

#: Increment of the numbers that are hashed, from pixel to pixel and from set to set of dimensions.
_GOLDEN = 0x9E3779B9


@variant_bound
class SequenceSampler(mi.Sampler):
    r"""Each pixel has the same sequence, randomized independently. With blue noise, pixels share
    the points of one sequence instead (``pixel_order.py``).

    Numbers are drawn in pairs of dimensions; a single number takes the first of a pair. When all
    dimensions of the sequence are used, the next ones come from another random copy of it, in
    another order (Latin supercube sampling).

    .. pluginparameters::

     * - sample_count
       - |int|
       - Samples per pixel: any number. (Default: 4)
     * - seed
       - |int|
       - Added to the seed of the render. (Default: 0)

    Parameters:
        props: The parameters of the scene.

    Attributes:
        sequence: The point sequence. The plugin sets it.
        blue_noise: Whether pixels share a sequence. Only for sequences whose aligned ranges of 2^k
            points are well distributed.
    """

    sequence: Sequence
    blue_noise = False

    def __init__(self, props: mi.Properties) -> None:
        self.name = props.plugin_name()
        count = read_parameter(self.name, props, "sample_count", 4, 1, MOST_SPP)
        base_seed = read_parameter(self.name, props, "seed", 0, 0, 2**32 - 1)
        # The base class gets the checked values; ``fork`` copies them too
        plain = mi.Properties("independent")
        plain["sample_count"], plain["seed"] = count, base_seed
        super().__init__(plain)
        self._base_seed = base_seed
        self._values = {"seed": base_seed}
        # Known only if it is set from Python; Mitsuba's own integrators take all samples in one
        # wavefront
        self._per_wavefront: int | None = None
        self._first = self._pixel_seed = self._offset = self._dimension = mi.UInt32(0)
        self._step = 1
        # The arguments of set_film(), and whether pixels share a sequence since the last seed()
        self._film: tuple[int, int] | None = None
        self._is_shared = False

    def read_dimensions(self, props: mi.Properties) -> int:
        """Reads the number of dimensions of the sequence.

        Raises:
            ValueError: It is odd, or out of range.
        """
        dimensions = read_parameter(self.name, props, "dimensions", 4, 2, 8)
        if dimensions % 2:
            raise ValueError(
                f'"{self.name}": the parameter "dimensions" is {dimensions}; it must be even'
            )
        self._values["dimensions"] = dimensions
        return dimensions

    def read_blue_noise(self, props: mi.Properties) -> None:
        """Reads whether pixels share a sequence, and the width of the film, which Mitsuba's own
        integrators do not tell the sampler."""
        self.blue_noise = read_parameter(self.name, props, "blue_noise", False)
        width = read_parameter(self.name, props, "film_width", 0, 0, 2**31 - 1)
        self._values.update(blue_noise=self.blue_noise, film_width=width)

    def set_film(self, width: int | None, first: int = 0) -> None:
        """Sets which pixels the lanes stand for when the sampler is seeded: the pixels of a film,
        row by row.

        Parameters:
            width: Pixels of a row. 0 if lanes do not stand for pixels, which turns off blue noise.
                ``None`` for the parameter ``film_width``, which is the default.
            first: The pixel of the first lane.
        """
        self._film = None if width is None else (width, first)

    # ---- Mitsuba's interface ----

    # Methods of the base class call the overrides again, so that code next to super() runs twice

    def fork(self) -> SequenceSampler:
        """A sampler with the same parameters, not seeded."""
        props = mi.Properties(self.name)
        for key, value in {**self._values, "sample_count": self.sample_count()}.items():
            props[key] = value
        fork = type(self)(props)
        fork._film = self._film
        return fork

    def clone(self) -> SequenceSampler:
        """A copy with the same state."""
        copy = self.fork()
        if self.wavefront_size() > 0:
            # Sets the number of lanes in the base class
            mi.Sampler.seed(copy, 0, self.wavefront_size())
        copy._per_wavefront, copy._step = self._per_wavefront, self._step
        copy._is_shared = self._is_shared
        for key in ("_first", "_pixel_seed", "_offset", "_dimension"):
            setattr(copy, key, mi.UInt32(getattr(self, key)))
        return copy

    def set_sample_count(self, spp: int) -> None:
        super().set_sample_count(spp)
        self._per_wavefront = None

    def set_samples_per_wavefront(self, samples_per_wavefront: int) -> None:
        super().set_samples_per_wavefront(samples_per_wavefront)
        self._per_wavefront = samples_per_wavefront

    def seed(self, seed: mi.UInt32 | int, wavefront_size: int = 0xFFFFFFFF) -> None:
        super().seed(seed, wavefront_size)
        self._step = self._per_wavefront or self.sample_count()
        step = dr.opaque(mi.UInt32, self._step)
        lane = dr.arange(mi.UInt32, self.wavefront_size())
        pixel = lane // step
        self._offset = lane - pixel * step
        # Not a literal, which would need new kernels for each seed
        word = mi.UInt32(seed) + self._base_seed
        dr.make_opaque(word)
        self._pixel_seed = mixed(mixed(word) + pixel * _GOLDEN)
        # A single pixel has no neighbours; mi.render() seeds one lane at its end
        shares = self.blue_noise and self.wavefront_size() > self._step
        width, first = self._find_film() if shares else (0, 0)
        self._is_shared = width > 0
        if self._is_shared:
            self._order_pixels(pixel + dr.opaque(mi.UInt32, first), width, mixed(word))
        self._first, self._dimension = dr.opaque(mi.UInt32, 0), mi.UInt32(0)

    def _find_film(self) -> tuple[int, int]:
        """The arguments of :meth:`set_film`.

        Raises:
            ValueError: The width of the film is not known, or is wrong.
        """
        if self._film is not None:
            return self._film
        width, pixels = self._values["film_width"], self.wavefront_size() // self._step
        if width == 0:
            raise ValueError(
                f'"{self.name}": the parameter "blue_noise" needs "film_width", the width of the '
                f"image in pixels, as this integrator does not say it"
            )
        if pixels % width:
            raise ValueError(
                f'"{self.name}": the parameter "film_width" is {width}; it must be the width of '
                f"the image, which has {pixels} pixels"
            )
        return width, 0

    def _order_pixels(self, pixel: mi.UInt32, width: int, word: mi.UInt32) -> None:
        """Assigns each pixel its range of points of the shared sequence."""
        levels = level_count(self.sample_count())
        order = z_order(pixel, dr.opaque(mi.UInt32, width), levels)
        # The same seed for all pixels of a tile
        self._pixel_seed = mixed(word + order.tile * _GOLDEN)
        place = shuffled(order.place, levels, self._pixel_seed)
        self._offset += place * dr.opaque(mi.UInt32, self.sample_count())

    def advance(self) -> None:
        # Does not call the base class, which would call this again; its state is not used
        self._first = self._first + dr.opaque(mi.UInt32, self._step)
        self._dimension = mi.UInt32(0)

    def schedule_state(self) -> None:
        dr.schedule(self._first, self._dimension)

    def next_1d(self, active: mi.Bool | bool = True) -> mi.Float:
        count = self._point_count()
        point, dimension, seed = self._next_pair(count)
        return self.sequence.coordinate(point, count, dimension, seed)

    def next_2d(self, active: mi.Bool | bool = True) -> mi.Point2f:
        count = self._point_count()
        point, dimension, seed = self._next_pair(count)
        x = self.sequence.coordinate(point, count, dimension, seed)
        y = self.sequence.coordinate(point, count, dimension + 1, mixed(seed))
        return mi.Point2f(x, y)

    def _point_count(self) -> int:
        """The number of points that a pixel, or all pixels that share a sequence, take from it."""
        count = self.sample_count()
        return count << (2 * level_count(count)) if self._is_shared else count

    def _next_pair(self, count: int) -> tuple[mi.UInt32, mi.UInt32, mi.UInt32]:
        """The index of the point, the first dimension of the pair, and the seed of this
        dimension."""
        number = self._dimension
        self._dimension = number + 1
        pairs = self.sequence.pairs
        number_of_set = number // pairs
        seed = mixed(self._pixel_seed + number_of_set * _GOLDEN)
        pair = number - number_of_set * pairs
        point = self.sequence.point(self._first + self._offset, count, seed)
        return point, 2 * pair, mixed(seed + 1 + pair)

    def to_string(self) -> str:
        values = {"sample_count": self.sample_count(), **self._values}
        lines = ",\n".join(f"  {key} = {value}" for key, value in values.items())
        return f"{self.name}[\n{lines}\n]"
