"""Records the vertices of chosen paths, and the light that these gain, while a render traces
them."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from ..transport.estimator import CameraRays
from ..transport.observer import Observer
from ..util.arrays import channel_mean
from ..util.spectra import to_rgb

#: The kinds of rows. Dr.Jit allows one increment of a counter in a loop. The walk may connect and
#: merge a vertex at several places of its loop, which therefore take turns with several kinds.
KINDS = range(16)
EMISSION, JOINED, VERTEX, SURVIVAL = KINDS[:4]
CONNECTIONS, MERGES = KINDS[4:8], KINDS[8:]

#: The columns of a row: whole numbers, and floats with their number of components.
_WHOLE = ("lane", "depth", "object", "bsdf", "flags")
_FLOATS = {"p": 3, "n": 3, "rgb": 3, "throughput": 4, "pdf": 1, "other_pdf": 1, "weight": 1}
_FLOAT_COUNT = sum(_FLOATS.values())

#: Of the column ``flags`` of a vertex: it lies in a medium. (``mi.BSDFFlags`` do not use the bit.)
IN_MEDIUM = 1 << 31

#: The depth of light that belongs to no vertex.
NO_DEPTH = 0xFFFFFFFF

#: A row: the values of its columns.
Row = dict[str, Any]


class Rows:
    """The rows of a pass, on the host.

    Parameters:
        columns: For each kind, the columns as arrays, ordered by lane; rows of a lane are in the
            order of its events. ``object`` and ``bsdf`` are numbers of Dr.Jit's registry.
    """

    def __init__(self, columns: dict[int, dict[str, np.ndarray]]) -> None:
        self._columns = columns

    def of_lane(self, lane: int) -> Rows:
        """The rows of one lane."""
        found = {}
        for kind, columns in self._columns.items():
            begin, end = np.searchsorted(columns["lane"], [lane, lane + 1])
            # Copies, so that the rows of the other lanes can be freed
            found[kind] = {name: column[begin:end].copy() for name, column in columns.items()}
        return Rows(found)

    def of_kind(self, kind: int) -> list[Row]:
        """The rows of this kind."""
        columns = self._columns[kind]
        return [
            {name: column[index] for name, column in columns.items()}
            for index in range(len(columns["lane"]))
        ]


class PathLog(Observer):
    """Observes the paths in chosen lanes of a pass. Estimators with light paths also tell it of
    connections and merges: it has the methods of their observers.

    Each event appends a row to the table of its kind, at a place that an atomic counter gives.

    Parameters:
        capacities: The largest number of rows of each kind in a pass.
    """

    can_be_frozen = compares = False

    def __init__(self, capacities: Sequence[int]) -> None:
        self.capacities = list(capacities)
        self._most = [dr.opaque(mi.UInt32, capacity) for capacity in capacities]
        self._whole = [dr.zeros(mi.UInt32, count * len(_WHOLE)) for count in capacities]
        self._floats = [dr.zeros(mi.Float, count * _FLOAT_COUNT) for count in capacities]
        self._connections, self._merges = itertools.cycle(CONNECTIONS), itertools.cycle(MERGES)
        dr.eval(self._whole, self._floats)

    def choose(self, chosen: mi.Bool, rays: CameraRays) -> None:
        """A pass begins, with these rays. The ``chosen`` lanes are recorded."""
        self._chosen, self._lane = chosen, dr.arange(mi.UInt32, dr.width(chosen))
        self._counts = [dr.zeros(mi.UInt32, 1) for _kind in KINDS]
        #: Turns the radiance along a ray into the radiance of a sample.
        self._importance = rays.importance * rays.weight
        self._wavelengths = rays.ray.wavelengths
        dr.eval(self._chosen, self._counts)

    @property
    def arrays(self) -> tuple[Any, ...]:
        """What the walk scatters into: it is evaluated together with the samples, because reading
        it before would launch the walk a second time."""
        return self._whole, self._floats, self._counts

    @property
    def needed(self) -> list[int]:
        """The capacities that the pass needs."""
        return [int(count[0]) for count in self._counts]

    def rows(self) -> Rows:
        """The rows of the pass."""
        return Rows({kind: self._columns(kind) for kind in KINDS})

    def _columns(self, kind: int) -> dict[str, np.ndarray]:
        count = min(int(self._counts[kind][0]), self.capacities[kind])
        whole = _first_rows(self._whole[kind], count, len(_WHOLE))
        floats = _first_rows(self._floats[kind], count, _FLOAT_COUNT)
        columns = {name: whole[:, index] for index, name in enumerate(_WHOLE)}
        ends = np.cumsum(list(_FLOATS.values()))[:-1]
        columns |= zip(_FLOATS, np.split(floats.astype(np.float64), ends, axis=1))
        order = np.argsort(columns["lane"], kind="stable")
        return {name: column[order] for name, column in columns.items()}

    # ---- What the walk reports ----

    def emission(self, path, ds, value, mis, pdf, active) -> None:
        self._add(
            EMISSION, path.depth, active & _is_light(value), object=_number(ds.emitter), p=ds.p,
            n=ds.d, rgb=self._rgb(value), throughput=path.β, pdf=path.arrival.pdf, other_pdf=pdf,
            weight=mis,
        )  # fmt: skip

    def vertex(self, vertex, active) -> None:
        self._depth = vertex.depth

    def connection(
        self, choice, vertex, ds, contribution, value, pdf, visible, tested
    ) -> None:
        whole = channel_mean(vertex.path.β * contribution)
        weight = dr.select(whole != 0, channel_mean(value) / whole, 0)
        self._add(
            next(self._connections), vertex.depth, visible & _is_light(value),
            object=_number(ds.emitter), p=ds.p, n=ds.d, rgb=self._rgb(value),
            throughput=vertex.path.β, pdf=ds.pdf, other_pdf=pdf, weight=weight,
        )  # fmt: skip

    def scattering(self, vertex, bs, active) -> None:
        si, flags, exists = vertex.si, bs.sampled_type, vertex.si.is_valid()
        if vertex.medium is not None:
            scatters = vertex.medium.scatters
            flags = dr.select(scatters, flags | IN_MEDIUM, flags)
            exists |= scatters
        self._add(
            VERTEX, vertex.depth, active & exists, object=_number(si.shape),
            bsdf=_number(vertex.bsdf), flags=flags, p=si.p, n=si.sh_frame.n,
            throughput=vertex.path.β, pdf=bs.pdf,
        )  # fmt: skip

    def survival(self, path, probability, active) -> None:
        self._add(SURVIVAL, path.depth, active & (probability < 1), weight=probability)

    # ---- What estimators with light paths report ----

    def start(self, rays, available) -> None:
        pass

    def joined(self, s, t, value, mis, competing, active) -> None:
        self._add(
            JOINED, t - 2, active & _is_light(value), flags=s, rgb=self._rgb(value), weight=mis
        )

    def merged(self, value, mis, competing, active, in_medium=False) -> None:
        is_light = active & _is_light(value)
        self._add(next(self._merges), self._depth, is_light, rgb=self._rgb(value), weight=mis)

    def photon(self, value, active) -> None:
        # The vertex may not be known yet: photons of media come before it
        is_light = active & _is_light(value)
        self._add(
            next(self._merges), mi.UInt32(NO_DEPTH), is_light, rgb=self._rgb(value),
            weight=mi.Float(1),
        )  # fmt: skip

    def splatted(self, s, position, value, mis, competing, active) -> None:
        pass

    def searched(self, count) -> None:
        pass

    def weighed(self, by_kind) -> None:
        pass

    def found_by(self, light_path) -> None:
        pass

    def traced(self, camera, whole) -> None:
        pass

    # ---- Helpers ----

    def _rgb(self, value: mi.Spectrum) -> mi.Color3f:
        return mi.Color3f(to_rgb(value * self._importance, self._wavelengths))

    def _add(self, kind: int, depth: mi.UInt32, active: mi.Bool, **columns: Any) -> None:
        """Appends a row in the chosen lanes that are ``active``. Columns that are not given keep
        what they held: nobody reads them for this kind."""
        active = active & self._chosen
        slot = dr.scatter_inc(self._counts[kind], mi.UInt32(0), active)
        active &= slot < self._most[kind]
        whole = {"lane": self._lane, "depth": depth}
        for place, name in enumerate(_WHOLE):
            if (value := whole.get(name, columns.get(name))) is not None:
                dr.scatter(self._whole[kind], mi.UInt32(value), slot * len(_WHOLE) + place, active)
        place = 0
        for name, width in _FLOATS.items():
            value = columns.get(name)
            if value is not None:
                parts = [value] if width == 1 else list(value)
                for offset, part in enumerate(parts):
                    target = slot * _FLOAT_COUNT + (place + offset)
                    dr.scatter(self._floats[kind], mi.Float(part), target, active)
            place += width


def _first_rows(table: mi.UInt32 | mi.Float, count: int, width: int) -> np.ndarray:
    """The first rows of a table, [count, width]."""
    if count == 0:
        return np.zeros((0, width), np.uint32)
    place = dr.arange(mi.UInt32, count * width)
    return dr.gather(type(table), table, place).numpy().reshape(count, width)


def _number(pointer: Any) -> mi.UInt32:
    return dr.reinterpret_array(mi.UInt32, pointer)


def _is_light(value: mi.Spectrum) -> mi.Bool:
    # A NaN is unequal to zero only if it is asked this way
    return ~(dr.max(dr.abs(value)) <= 0)
