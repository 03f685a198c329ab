"""Compares ways to sample the light of an environment, at equal samples.

    .venv/bin/python examples/environment.py vertex map.hdr
    .venv/bin/python examples/environment.py images sunny_gloss window

``vertex`` looks at one vertex with nothing in between, for several materials: σ/μ of what N
connections bring together, and the exponent with which it falls from N = 4 to 256. MIS takes N/2
light samples and N/2 BSDF samples (balance heuristic); two-stage sampling divides the map N times,
as in its source, alone and beside one BSDF sample (power heuristic), as in a render. All have
randomly shifted Hammersley points.

``images`` renders scenes: error and CPU time of each integrator relative to ``path``, and the
efficiency 1 / (error · time); one of them is ``path`` with the sampler ``multijitter``. Errors are
those of ``examples/equal_samples.py``.
"""

from __future__ import annotations

from pathlib import Path

import click
import numpy as np
from equal_samples import error, load, options, print_header, print_row, render_in_turns, title

import mitsuba_ext  # noqa: F401
from mitsuba_ext.decisions.next_event.two_stage import TwoStage
from mitsuba_ext.transport.mis import power_heuristic
from mitsuba_ext.transport.path_decisions import EmitterSampling, LightNumbers

import drjit as dr  # isort: skip
import mitsuba as mi  # isort: skip

COUNTS = (4, 16, 64, 256)

#: Vertices that are looked at, each with numbers of its own.
VERTICES = 1 << 13

MATERIALS = {
    "alpha 0.02": {"type": "roughconductor", "alpha": 0.02},
    "alpha 0.2": {"type": "roughconductor", "alpha": 0.2},
    "anisotropic 0.05, 1": {"type": "roughconductor", "alpha_u": 0.05, "alpha_v": 1.0},
    "soft (0.5)": {"type": "roughconductor", "alpha": 0.5},
    "diffuse": {"type": "diffuse"},
}

INTEGRATORS = {
    "path": {"type": "path"},
    "16 connections": {"type": "composed_path", "connections": 16},
    "resampled": {"type": "composed_path", "next_event": "resampled"},
    "portals": {"type": "composed_path", "next_event": "portals"},
    "two_stage 1": {"type": "two_stage", "light_samples": 1},
    "two_stage 16": {"type": "two_stage", "light_samples": 16},
    "triple product 16": {"type": "two_stage", "visibility": "primary"},
    "half reallocated": {"type": "two_stage", "visibility": "primary", "reallocated": 0.5},
    "triple product 16, in the world": {
        "type": "two_stage", "visibility": "world", "splits": 32,
    },
    "neepp": {"type": "neepp"},
}  # fmt: skip

#: ``path`` with this sampler is a rival too.
SAMPLER = "multijitter"
STRATIFIED = f"path, {SAMPLER}"


def vertex_of(file: str, bsdf: dict) -> tuple[mi.Scene, mi.SurfaceInteraction3f]:
    """A plane under a map, and a point of it, seen from 40 degrees above."""
    turned = mi.ScalarTransform4f().rotate([1, 0, 0], 90)
    scene = mi.load_dict({
        "type": "scene", "sky": {"type": "envmap", "filename": file, "to_world": turned},
        "plane": {"type": "rectangle", "bsdf": {"type": "twosided", "bsdf": bsdf}},
    })  # fmt: skip
    origin = mi.Point3f(0.3, -1.1, 0.95)
    si = scene.ray_intersect(mi.Ray3f(origin, dr.normalize(-mi.Vector3f(origin))))
    return scene, dr.gather(mi.SurfaceInteraction3f, si, dr.zeros(mi.UInt32, VERTICES))


def hammersley(index: mi.UInt32, count: int, shift: mi.Point2f) -> mi.Point2f:
    point = mi.Point2f((mi.Float(index) + 0.5) / count, mi.Float(dr.brev(index)) * 2.0**-32) + shift
    return dr.minimum(point - dr.floor(point), dr.one_minus_epsilon(mi.Float))


def shifts(stream: int) -> mi.Point2f:
    numbers = mi.PCG32(VERTICES, 1, stream)
    return mi.Point2f(numbers.next_float32(), numbers.next_float32())


def balance(pdf: mi.Float, other: mi.Float, by_mis: bool = True) -> mi.Float | float:
    return pdf / (pdf + other) if by_mis else 1.0


@dr.syntax
def connections(scene, si, decision: EmitterSampling, count: int, total: int, by_mis: bool):
    """What ``count`` connections bring; ``by_mis`` beside as many BSDF samples."""
    ctx, bsdf, active, shift = mi.BSDFContext(), si.bsdf(), mi.Bool(True), shifts(1)
    place = decision.visit(decision.begin(None, None), scene, si, active)
    sum, index = mi.Float(0), mi.UInt32(0)
    while index < total:
        numbers = LightNumbers(hammersley(index, count, shift))
        ds, light, _ = decision.sample(place, scene, numbers, si, active)
        value, pdf = bsdf.eval_pdf(ctx, si, si.to_local(ds.d))
        weight = balance(ds.pdf, pdf, by_mis)
        sum += dr.select(ds.pdf > 0, mi.luminance(value * light) * weight, 0)
        index += 1
    return sum / count


@dr.syntax
def bsdf_samples(scene, si, count: int, total: int):
    """What ``count`` BSDF samples bring beside as many light samples."""
    ctx, bsdf, shift, lobe = mi.BSDFContext(), si.bsdf(), shifts(2), mi.PCG32(VERTICES, 1, 3)
    sum, index, environment = mi.Float(0), mi.UInt32(0), scene.environment()
    first = lobe.next_float32()
    while index < total:
        turned = first + mi.Float(index) * 0.618034
        bs, reflected = bsdf.sample(
            ctx, si, turned - dr.floor(turned), hammersley(index, count, shift)
        )
        seen = dr.zeros(mi.SurfaceInteraction3f)
        seen.wi = -si.to_world(bs.wo)
        ds = dr.zeros(mi.DirectionSample3f)
        ds.d = -seen.wi
        pdf = environment.pdf_direction(si, ds)
        value = mi.luminance(reflected * environment.eval(seen)) * balance(bs.pdf, pdf)
        sum += dr.select(bs.pdf > 0, value, 0)
        index += 1
    return sum / count


@dr.syntax
def two_stage_with_mis(scene, si, count: int, total: int):
    """What ``count`` connections bring beside one BSDF sample, as in a render."""
    ctx, bsdf, active, shift = mi.BSDFContext(), si.bsdf(), mi.Bool(True), shifts(1)
    decision, others = TwoStage(scene, count, False), mi.PCG32(VERTICES, 1, 4)
    place = decision.visit(decision.begin(None, None), scene, si, active)
    lobe, point = others.next_float32(), mi.Point2f(others.next_float32(), others.next_float32())
    bs, reflected = bsdf.sample(ctx, si, lobe, point)
    seen = dr.zeros(mi.SurfaceInteraction3f)
    seen.wi = -si.to_world(bs.wo)
    pdf = decision.remember(place, scene, -seen.wi, bs.pdf, active).density
    weight = power_heuristic(bs.pdf, count * pdf)
    sum, index = mi.Float(0), mi.UInt32(0)
    sum += mi.luminance(reflected * scene.environment().eval(seen)) * weight * count
    while index < total:
        numbers = LightNumbers(hammersley(index, count, shift))
        ds, light, _ = decision.sample(place, scene, numbers, si, active)
        value, pdf = bsdf.eval_pdf(ctx, si, si.to_local(ds.d))
        weight = power_heuristic(count * ds.pdf, pdf)
        sum += dr.select(ds.pdf > 0, mi.luminance(value * light) * weight, 0)
        index += 1
    return sum / count


def spread(values: mi.Float) -> float:
    values = values.numpy().astype(np.float64)
    return float(values.std() / values.mean())


@click.group()
def main() -> None:
    mi.set_variant("llvm_ad_rgb")
    mi.set_log_level(mi.LogLevel.Error)


@main.command()
@click.argument("maps", nargs=-1, required=True)
def vertex(maps: tuple[str, ...]) -> None:
    """σ/μ of connections at one vertex, under MAPS."""
    columns = [f"N = {count}" for count in COUNTS]
    print_header(["map, material", "method", *columns, "exponent"])
    for file in maps:
        for name, bsdf in MATERIALS.items():
            scene, si = vertex_of(file, bsdf)
            methods = ("MIS", "two-stage", "two-stage, MIS")
            rows: dict[str, list[float]] = {method: [] for method in methods}
            for count in COUNTS:
                half = dr.opaque(mi.UInt32, count // 2)
                both = connections(scene, si, EmitterSampling(), count // 2, half, True)
                rows["MIS"].append(spread(both + bsdf_samples(scene, si, count // 2, half)))
                alone = connections(
                    scene, si, TwoStage(scene, count, False), count,
                    dr.opaque(mi.UInt32, count), False,
                )  # fmt: skip
                rows["two-stage"].append(spread(alone))
                whole = two_stage_with_mis(scene, si, count, dr.opaque(mi.UInt32, count))
                rows["two-stage, MIS"].append(spread(whole))
            for method, values in rows.items():
                slope = np.polyfit(np.log(COUNTS), np.log(values), 1)[0]
                cells = [*(f"{value:.2g}" for value in values), f"{slope:.2f}"]
                print_row([f"{Path(file).stem}, {name}", method, *cells])


@main.command()
@options
@click.option("--only", multiple=True, type=click.Choice([*list(INTEGRATORS)[1:], STRATIFIED]),
              help="These integrators.")  # fmt: skip
def images(
    names: tuple[str, ...], max_depth: int, spp: int, seeds: int, size: tuple, only: tuple[str, ...]
) -> None:
    """Compares integrators on the scenes NAMES."""
    others = list(only) or [STRATIFIED, *list(INTEGRATORS)[1:]]
    print_header(["scene", *(f"{kind}: error | time | efficiency" for kind in others)])
    chosen = {kind: value for kind, value in INTEGRATORS.items() if kind in ("path", *others)}
    for name in names:
        renders = render_in_turns(load(name, size), chosen, max_depth, spp, seeds)
        if STRATIFIED in others:
            path = {STRATIFIED: INTEGRATORS["path"]}
            scene = load(name, size, sampler=SAMPLER)
            renders |= render_in_turns(scene, path, max_depth, spp, seeds)
        mean = np.mean([r.mean for r in renders.values()], axis=0)
        errors = {kind: error(r.variance, mean) for kind, r in renders.items()}
        cells = [title(name)]
        for kind in others:
            ratio = errors[kind] / errors["path"]
            slower = renders[kind].time / renders["path"].time
            cells.append(f"{ratio:.2f} | {slower:.2f} | {1 / (ratio * slower):.2f}")
        print_row(cells)


if __name__ == "__main__":
    main()
