"""What renders, a CPU or a GPU, and how large its passes may be.

Passes trace Python and launch kernels: fewer and longer passes cost less, until their memory or
their time is too much. Random numbers depend on the length of passes. Therefore, it follows from
the size of the memory, and images are the same from render to render on a machine, unless there is
little free memory.
"""

from __future__ import annotations

import functools
from dataclasses import dataclass

import drjit as dr

from ..util.memory import Memory, gpu_memory, machine_memory

#: The largest share of the memory for what a pass stores. A CPU shares its memory with other
#: programs. A GPU loses more time between two passes.
_CPU_SHARE, _GPU_SHARE = 1 / 28, 1 / 3

#: The binary digits to which the share is rounded down. On a CPU, it is a power of two, so that
#: most machines have passes of the same length, and thus the same images.
_CPU_DIGITS, _GPU_DIGITS = 1, 3

#: The memory of a pass on a GPU is at most this number of bytes: half of it, which one array may
#: have, is less than 2^32 words.
_MOST_ON_GPU = 7 << 32

#: The memory of a pass on a CPU is at most this number of bytes. (Two cores took 4 % less time for
#: "bdpt" in glass_lamp, 1280x720, with 1 GiB than with 512 MiB, and no less with 2 or 4 GiB. More
#: cores probably gain more, since only one of them traces Python: this was not measured.)
_MOST_ON_CPU = 1 << 31

#: The memory of a pass is at least this number of bytes, also if less is free.
_LEAST = 1 << 24

#: The memory of a pass where the memory of the device is not known: on a CPU, and on a GPU.
_UNKNOWN = {False: 1 << 29, True: 1 << 31}

#: A pass may take this number of times the memory that it needs by the sizes of its arrays, because
#: Dr.Jit rounds sizes up to powers of two. (Measured at the peak of "bdpt", "vcm", "sppm" and
#: "light_tracer", in cornell_box and veach-ajar: 1.3 to 2.3.)
_ROUNDING = 2.5

#: Samples per pass, at most. Tracing a pass in Python takes 5 to 70 ms (many materials take
#: longest). The pass itself takes two or three seconds on two CPU cores, and half a second for
#: "path" on an H100.
_CPU_SAMPLES, _GPU_SAMPLES = 1 << 21, 1 << 26

#: Bytes of a sample of a camera path on a GPU, about, with what learners record.
_CAMERA_BYTES = 128

#: Bytes of a sample of a camera path on a CPU (the state of its random numbers before and after the
#: pass), and the memory for them in units of the memory of a pass, a quarter of the whole.
_STATE_BYTES, _STATE_MEMORY = 24, 7

#: Lanes that a GPU runs together. If they are samples of one pixel, they trace coherent rays, and
#: Dr.Jit can add them to the film as one sum.
_WARP = 32

_MAX_WAVEFRONT = (1 << 32) - 1

#: The size of the largest array of a pass where paths are long, in units of the memory of a pass: a
#: CPU has 28 times that memory, and a GPU three times. And its size in bytes: the arrays of Dr.Jit
#: have at most 2^32 entries.
_CPU_ARRAY, _GPU_ARRAY, _ARRAY_BYTES = 8.0, 2 / 3, 4 * _MAX_WAVEFRONT


@dataclass(frozen=True)
class SampleBytes:
    """The memory of a sample in a pass, as far as it depends on the number of samples.

    Attributes:
        usual: Its bytes, about; 0 if it stores no more than a path.
        largest: Its bytes in the largest array, in scenes whose paths are as long as they can be.
    """

    usual: float = 0.0
    largest: float = 0.0


@dataclass(frozen=True)
class Device:
    """What renders.

    Attributes:
        is_gpu: Whether it is a GPU.
        pass_bytes: The memory for what a pass stores.
    """

    is_gpu: bool
    pass_bytes: int

    @classmethod
    def with_memory(cls, is_gpu: bool, memory: Memory | None) -> Device:
        """The device with this memory; with ``None``, its memory is not known."""
        if memory is None:
            return cls(is_gpu, _UNKNOWN[is_gpu])
        found = _share(is_gpu, memory)
        while found > _LEAST and _ROUNDING * found > memory.free:
            found //= 2
        return cls(is_gpu, found)

    @property
    def pass_samples(self) -> int:
        """The number of samples of a pass, if they cost and store no more than paths."""
        if not self.is_gpu:
            return _CPU_SAMPLES
        return min(_GPU_SAMPLES, self.lanes(SampleBytes(_CAMERA_BYTES)))

    @property
    def most_pass_samples(self) -> int:
        """The most samples that a pass may have, if they store no more than paths."""
        if self.is_gpu:
            return self.pass_samples
        return min(_MAX_WAVEFRONT - 1, _STATE_MEMORY * self.pass_bytes // _STATE_BYTES)

    @property
    def warp(self) -> int:
        """Of how many samples of a pixel the passes are multiples."""
        return _WARP if self.is_gpu else 1

    def lanes(self, sample: SampleBytes) -> int:
        """The number of samples for which the memory of a pass suffices, at least 1."""
        found: float = _MAX_WAVEFRONT
        if sample.usual > 0:
            found = min(found, self.pass_bytes / sample.usual)
        if sample.largest > 0:
            share = _GPU_ARRAY if self.is_gpu else _CPU_ARRAY
            array = min(share * self.pass_bytes, _ARRAY_BYTES)
            found = min(found, array / sample.largest)
        return max(1, int(found))


@functools.cache
def device_of(kind: type) -> Device:
    """The device of this type of arrays, such as ``mi.Float``. Its free memory is the free memory
    of the first call; a render begins with :func:`look_again`."""
    is_gpu = dr.backend_v(kind) == dr.JitBackend.CUDA
    read = gpu_memory if is_gpu else machine_memory
    memory = read()
    if memory is not None and memory.free < _ROUNDING * _share(is_gpu, memory):
        # Dr.Jit keeps the memory of former renders
        dr.flush_malloc_cache()
        memory = read()
    return Device.with_memory(is_gpu, memory)


def look_again() -> None:
    """Forgets how much memory was free."""
    device_of.cache_clear()


def _share(is_gpu: bool, memory: Memory) -> int:
    """The memory of a pass if nothing else needs memory."""
    share, digits = (_GPU_SHARE, _GPU_DIGITS) if is_gpu else (_CPU_SHARE, _CPU_DIGITS)
    found = max(_LEAST, int(share * memory.total))
    rest = max(0, found.bit_length() - digits)
    found = found >> rest << rest
    return min(found, _MOST_ON_GPU if is_gpu else _MOST_ON_CPU)
