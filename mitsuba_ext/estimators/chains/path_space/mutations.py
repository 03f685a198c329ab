"""Mutations of light paths."""

from __future__ import annotations

from dataclasses import dataclass, replace

import drjit as dr
import mitsuba as mi

from ....transport.numbers import Numbers, hashed_2d
from .densities import log_density, log_factors
from .evaluation import Evaluation, trace_from_camera
from .light_subpaths import grow_from_light
from .memory import Head, PathMemory, stride
from .plan import Plan
from .space import PathSpace
from .techniques import Techniques

#: The kinds of mutations.
NEW_PATH, BIDIRECTIONAL, FROM_CAMERA, FROM_LIGHT = 0, 1, 2, 3

#: The distances on the film by which perturbations move paths: the minimum in pixels, and the
#: maximum in units of the film's width.
_MIN_PIXELS, _MAX_WIDTHS = 0.1, 0.1

#: Their multiples, modulo one, are a low-discrepancy sequence in the square (M. Roberts, 2018).
_LATTICE = (0.7548776662466927, 0.5698402909980532)


@dataclass(frozen=True)
class Switches:
    """The mutations in use, besides new paths. A vertex is *discrete* if a delta lobe of its BSDF
    scatters the path (:attr:`Place.is_discrete`).

    Attributes:
        bidirectional: Whether to replace part of a path by a bidirectional random walk.
        lens: Whether to move the position on the film, and trace the path from there to its first
            two consecutive vertices that are not discrete.
        multi_chain: The same for paths on which directions at other vertices must also change.
        caustic: Whether to change the direction at the light, or at the second vertex from the
            camera that is not discrete, and trace the path from there to the camera.
    """

    bidirectional: bool = True
    lens: bool = True
    multi_chain: bool = True
    caustic: bool = True


@dataclass
class Proposal:
    """A proposed path of a chain.

    Attributes:
        head: The path; its vertices are in memory.
        found: Its contribution.
        log_density: The logarithm of its density as a new path.
        log_ratio: The logarithm of the ratio of the reverse mutation's density to this mutation's.
        technique: The index of the technique that makes a new path.
    """

    head: Head
    found: Evaluation
    log_density: mi.Float
    log_ratio: mi.Float
    technique: mi.UInt32


# Not a dataclass: Dr.Jit would treat one that a loop uses as part of the loop's state
class Mutations:
    """Makes new paths, and paths from other paths.

    Source: E. Veach, L. Guibas, *Metropolis Light Transport*, SIGGRAPH 1997, section 5; D. Cline,
    PhD thesis, 2007, section 7.12.

    Parameters:
        space: The paths of the scene.
        switches: The mutations in use.
    """

    def __init__(self, space: PathSpace, switches: Switches) -> None:
        self.space, self._switches = space, switches
        # Perturbations are proposed more often because they are accepted more often
        self.kinds = [
            kind for kind, shares in (
                (BIDIRECTIONAL, 1 if switches.bidirectional else 0),
                (FROM_CAMERA, 2 if switches.lens or switches.multi_chain else 0),
                (FROM_LIGHT, 2 if switches.caustic and space.connectable is not None else 0),
            ) for _ in range(shares)
        ]  # fmt: skip
        #: The distribution of techniques that make new paths.
        self.techniques = Techniques(space.least, space.most)

    # ---- New paths ----

    def new_path(
        self, memory: PathMemory, at: mi.UInt32, numbers: Numbers, active: mi.Bool
    ) -> tuple[PathMemory, Numbers, Proposal]:
        """Makes a new, independent path. The first two numbers are its position on the film."""
        film = numbers.next_2d()
        technique, head, plan = self._fresh(at, film, numbers)
        memory, numbers, head, found = self._make(memory, head, head, plan, numbers, active)
        density = self._density(memory, head, found.active)
        return memory, numbers, Proposal(head, found, density, mi.Float(0), technique)

    def _fresh(
        self, at: mi.UInt32, film: mi.Point2f, numbers: Numbers
    ) -> tuple[mi.UInt32, Head, Plan]:
        """Chooses the technique and the camera numbers of a new path, which has no vertices yet."""
        technique, length, grown = self.techniques.choose(numbers.next_1d())
        aperture, time, wavelength = numbers.next_2d(), numbers.next_1d(), numbers.next_1d()
        head = Head(at, length, film, aperture, time, wavelength, dr.zeros(mi.UInt32, 1))
        return technique, head, Plan(mi.UInt32(0), grown, length + 1, mi.Bool(False))

    def _density(self, memory: PathMemory, path: Head, active: mi.Bool) -> mi.Float:
        return log_density(
            self.space, memory, path, mi.UInt32(0), path.length + 1, active, self.techniques
        )

    # ---- Mutations ----

    def mutate(
        self,
        memory: PathMemory,
        path: Head,
        density: mi.Float,
        kind: mi.UInt32,
        film: mi.Point2f,
        numbers: Numbers,
    ) -> tuple[PathMemory, Numbers, Proposal]:
        """Makes a proposal from ``path``.

        Parameters:
            density: :attr:`Proposal.log_density` of ``path``.
            kind: The requested kind of mutation. A path that does not allow this kind gets another
                one (:meth:`_possible`).
            film: The film position of a new path if its first vertex is made from the camera.
        """
        space = self.space
        technique, fresh, plan = self._fresh(stride(space.most) - path.at, film, numbers)
        is_new = kind == NEW_PATH
        kind, first, second = self._possible(memory, path, kind)
        choice = numbers.next_2d()
        bidirectional = self._part(path, choice, numbers.next_1d())
        from_camera = kind == FROM_CAMERA
        # The proposal's film position, unless its first vertex is made from the light
        moved, is_inside = self._moved(path.film, choice)
        place = dr.select(is_new | (bidirectional.keeps == 0), fresh.film, path.film)
        place = dr.select(from_camera, moved, place)
        zero, one = mi.UInt32(0), mi.UInt32(1)

        def chosen(new, part, camera, light):
            rest = dr.select(from_camera, camera, light)
            return dr.select(is_new, new, dr.select(kind == BIDIRECTIONAL, part, rest))

        perturbs = ~is_new & (kind != BIDIRECTIONAL)
        plan = Plan(
            chosen(plan.keeps, bidirectional.keeps, zero, zero),
            chosen(plan.grown, bidirectional.grown, first, zero),
            chosen(plan.rest, bidirectional.rest, first + one, second),
            perturbs,
        )
        head = Head(
            fresh.at,
            dr.select(is_new, fresh.length, path.length),
            place,
            dr.select(is_new, fresh.aperture, path.aperture),
            dr.select(is_new, fresh.time, path.time),
            dr.select(is_new, fresh.wavelength, path.wavelength),
            path.emitter,
        )
        active = is_new | (kind == BIDIRECTIONAL) | (from_camera & is_inside) | (kind == FROM_LIGHT)
        memory = _copy(memory, path, head, active & ~is_new)
        memory, numbers, head, found = self._make(memory, path, head, plan, numbers, active)

        # ----- The densities of this mutation and of the reverse mutation -----
        found_density = self._density(memory, head, found.active)
        ratio = density - found_density
        if BIDIRECTIONAL in self.kinds:
            is_part = found.active & (kind == BIDIRECTIONAL) & ~is_new
            back, there = (
                log_density(space, memory, which, plan.keeps, plan.rest, is_part)
                for which in (path, head)
            )
            ratio = dr.select(is_part, back - there, ratio)
        if FROM_CAMERA in self.kinds or FROM_LIGHT in self.kinds:
            is_perturbed = found.active & perturbs
            last = dr.select(from_camera, first, second - 1)
            back, there = (
                log_factors(memory, which, last, ~from_camera, is_perturbed)
                for which in (path, head)
            )
            ratio = dr.select(is_perturbed, back - there, ratio)
        return memory, numbers, Proposal(head, found, found_density, ratio, technique)

    def kind(self, sample: mi.Float, new_path: mi.Float) -> mi.UInt32:
        """The kind of mutation that ``sample`` chooses, with probability ``new_path`` for new
        paths, and equal probabilities for all others in ``kinds``."""
        if not self.kinds:
            return mi.UInt32(NEW_PATH)
        x = dr.maximum(sample - new_path, 0) / dr.maximum(1 - new_path, 1e-6) * len(self.kinds)
        kind = mi.UInt32(self.kinds[-1])
        for number in range(len(self.kinds) - 1, 0, -1):
            kind = dr.select(x < number, self.kinds[number - 1], kind)
        return dr.select(sample < new_path, NEW_PATH, kind)

    def place(self, lane: mi.UInt32, word: mi.UInt32, step: mi.UInt32) -> mi.Point2f:
        """The film position of a new path in each lane: stratified over the lanes, and uniformly
        distributed in each of them."""
        shift = hashed_2d(word, step)
        # Integers: floats would lose the fractional digits of large multiples
        x, y = (lane * mi.UInt32(round(c * 2**32) & 0xFFFFFFFF) for c in _LATTICE)
        place = mi.Point2f(mi.Float(x >> 8), mi.Float(y >> 8)) * 2.0**-24 + shift
        return dr.minimum(place - dr.floor(place), 1 - 2.0**-24)

    # ---- Which vertices are replaced ----

    @dr.syntax
    def _possible(
        self, memory: PathMemory, path: Head, kind: mi.UInt32
    ) -> tuple[mi.UInt32, mi.UInt32, mi.UInt32]:
        """The kind of mutation to make from a path; the last vertex that moves if it is perturbed
        from the camera; and the first vertex that stays if it is perturbed from the light.

        All three depend only on the path's length, and on which of its vertices are discrete. A
        perturbation changes neither, so the reverse mutation is of the same kind.
        """
        # The first two consecutive vertices that can be connected
        index, turns, is_open = mi.UInt32(1), mi.UInt32(0), mi.Bool(True)
        while is_open & (index < path.length):
            here = memory.places[path.at + index].is_discrete == 1
            ahead = memory.places[path.at + index + 1].is_discrete == 1
            is_open = here | (ahead & (index + 1 < path.length))
            if is_open:
                turns += dr.select(here, 0, 1)
                index += 1
        first = index
        # The first vertex after vertex 1 that can be connected
        second = mi.UInt32(2)
        while (second < path.length) & (memory.places[path.at + second].is_discrete == 1):
            second += 1
        by_camera = dr.select(turns > 0, self._switches.multi_chain, self._switches.lens)
        sees = memory.places[path.at + 1].is_discrete == 0
        is_beam = self.space.kinds.is_beam(path.emitter, second >= path.length)
        by_light = (
            mi.Bool(FROM_LIGHT in self.kinds) & sees & (path.length > 1)
            & ~((second >= path.length) & is_beam)
        )  # fmt: skip
        nothing = mi.UInt32(9)
        other = mi.UInt32(BIDIRECTIONAL) if BIDIRECTIONAL in self.kinds else nothing
        from_camera = dr.select(
            by_camera, FROM_CAMERA, dr.select(by_light, FROM_LIGHT, other)
        )
        from_light = dr.select(
            by_light, FROM_LIGHT, dr.select(by_camera, FROM_CAMERA, other)
        )
        made = dr.select(kind == FROM_CAMERA, from_camera, kind)
        made = dr.select(kind == FROM_LIGHT, from_light, made)
        return made, first, second

    def _part(self, path: Head, choice: mi.Point2f, sample: mi.Float) -> Plan:
        """A random part of a path to replace, which may be only the light. The part kept at the
        light's end is never only the light, because a walk from the light cannot begin at a given
        point."""
        length = path.length
        # The last vertex kept at the camera's end
        keeps = dr.minimum(mi.UInt32(choice.x * mi.Float(length)), length - 1)
        # The first vertex kept at the light's end: keeps + 2 … length − 1, or none
        ends = dr.select(length > keeps + 2, length - keeps - 2, 0) + 1
        rest = keeps + 2 + dr.minimum(mi.UInt32(choice.y * mi.Float(ends)), ends - 1)
        rest = dr.select(rest >= length, length + 1, rest)
        ways = rest - keeps
        grown = keeps + dr.minimum(mi.UInt32(sample * mi.Float(ways)), ways - 1)
        return Plan(keeps, grown, rest, mi.Bool(False))

    def _moved(self, film: mi.Point2f, sample: mi.Point2f) -> tuple[mi.Point2f, mi.Bool]:
        """A position near another one, and whether it is on the film."""
        width = float(self.space.size.x)
        high = max(_MAX_WIDTHS * width, 2 * _MIN_PIXELS)
        pixels = _MIN_PIXELS * dr.power(high / _MIN_PIXELS, sample.x)
        y, x = dr.sincos(dr.two_pi * sample.y)
        moved = film + mi.Point2f(x, y) * pixels / self.space.size
        return moved, dr.all((moved >= 0) & (moved < 1))

    def _make(self, memory, old: Head, new: Head, plan: Plan, numbers: Numbers, active):
        """Makes the new vertices of a plan, and evaluates the path."""
        space = self.space
        ray = mi.Ray3f(space.camera_ray(new).ray)
        grows = active & (plan.grown + 1 < plan.rest)
        memory, new, numbers, is_made = grow_from_light(
            space, memory, old, new, plan, ray, numbers, grows
        )
        active = active & (~grows | is_made)
        seen_from_light = active & (plan.grown == 0)
        first = memory.places[new.at + 1]
        film, is_seen = space.on_film(first.p, ray, new, seen_from_light)
        new = replace(new, film=dr.select(seen_from_light, film, new.film))
        # Only camera paths find lights that are directly visible
        active &= ~seen_from_light | (is_seen & (new.length > 1))
        memory, new, numbers, found = trace_from_camera(
            space, memory, old, new, plan, numbers, active
        )
        return memory, numbers, new, found


@dr.syntax
def _copy(memory: PathMemory, path: Head, to: Head, active: mi.Bool) -> PathMemory:
    """Copies the vertices of a path."""
    index = dr.full(mi.UInt32, 1, dr.width(path.film))
    while active & (index <= path.length):
        memory.places[to.at + index] = memory.places[path.at + index]
        index += 1
    return memory
