"""Compares ways to sample the light of an environment, at equal samples.

    .venv/bin/python benchmarks/environment.py vertex map.hdr
    .venv/bin/python benchmarks/environment.py floor map.hdr

``vertex`` looks at one vertex with nothing in between, for several materials: σ/μ of what N
connections bring together, and the exponent with which it falls from N = 4 to 256. MIS takes N/2
light samples and N/2 BSDF samples (balance heuristic); two-stage sampling divides the map N times,
as in its source, alone and beside one BSDF sample (power heuristic), as in a render. All have
randomly shifted Hammersley points.

``floor`` renders the direct light of three_balls with other floors and maps: σ/μ of the pixels that
show nothing but the floor, with the same number of connections for each method. After Table 5.1 of
Cline's dissertation.
"""

from __future__ import annotations

import re
from pathlib import Path

import click
import numpy as np
from equal_samples import SCENES, camera_rays, print_header, print_row, render_in_turns

import mitsuba_ext  # noqa: F401
from mitsuba_ext.techniques.two_stage_lights.two_stage import TwoStage
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

#: Sampler of the methods that have samples of their own in ``floor``.
SAMPLER = "multijitter"

#: Floors of ``floor``: that of the scene, and metals. A Blinn lobe of roughness 0.1 in pbrt has the
#: exponent 10, which is about as wide as α = 0.41.
FLOORS = {
    "plastic 0.12": "",
    **{
        f"metal {alpha}": '<bsdf type="twosided" id="floor"><bsdf type="roughconductor">'
        f'<string name="material" value="Ag"/><float name="alpha" value="{alpha}"/></bsdf></bsdf>'
        for alpha in (0.41, 0.2, 0.12)
    },
}

#: In the text of the scene.
FLOOR = re.compile(r'<bsdf type="twosided" id="floor">.*?</bsdf></bsdf>', re.DOTALL)
BALLS = re.compile(r'<shape type="sphere">.*?</shape>', re.DOTALL)


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


def floor_scene(file: str, floor: str, with_balls: bool, size: tuple, sampler: str) -> mi.Scene:
    """three_balls with another map, another floor, or without its balls."""
    scene = SCENES / "three_balls.xml"
    mi.file_resolver().prepend(str(scene.parent))
    text = scene.read_text().replace("assets/clear_sky.exr", str(Path(file).resolve()))
    text = text.replace('type="independent"', f'type="{sampler}"')
    if floor:
        text = FLOOR.sub(floor, text)
    if not with_balls:
        text = BALLS.sub("", text)
    width, height = map(str, size)
    return mi.load_string(text, width=width, height=height, rfilter="box", optimize=False)


def shows_floor(scene: mi.Scene, rays: int = 16) -> np.ndarray:
    """The pixels all of whose rays meet the floor: [height, width]."""
    width, height = scene.sensors()[0].film().crop_size()
    si = scene.ray_intersect(camera_rays(scene, rays))
    hits = (si.is_valid() & (si.p.z < 1e-4)).numpy()
    return hits.reshape(height, width, rays).all(axis=-1)


def floor_methods(count: int) -> dict[str, tuple[str, dict, int]]:
    """Methods that make so many connections, or BSDF samples, for each pixel: sampler, integrator,
    and samples per pixel."""
    many = {"type": "composed_path", "connections": count}
    per_ray = max(1, count // 4)
    return {
        "BSDF alone": (SAMPLER, {"type": "composed_path", "mis": "bsdf"}, count),
        "light alone": ("independent", {**many, "mis": "light"}, 1),
        "light alone, as many rays": (SAMPLER, {"type": "composed_path", "mis": "light"}, count),
        "MIS": (SAMPLER, {"type": "path"}, count),
        "two-stage": (
            "independent", {"type": "two_stage", "light_samples": count, "splits": count}, 1,
        ),
        "two-stage, 4 rays": (
            SAMPLER, {"type": "two_stage", "light_samples": per_ray, "splits": count}, 4,
        ),
    }  # fmt: skip


@main.command()
@click.option("--without-balls", is_flag=True, help="Nothing is in between.")
@click.option("--floor", "floors", multiple=True, type=click.Choice(list(FLOORS)))
@click.option("--count", "counts", multiple=True, type=int, default=(16, 64))
@click.option("--seeds", default=6)
@click.option("--size", type=(int, int), default=(96, 54))
@click.argument("file")
def floor(
    file: str, size: tuple, seeds: int, counts: tuple[int, ...], floors: tuple[str, ...],
    without_balls: bool,
) -> None:  # fmt: skip
    """σ/μ on the floor of three_balls under the map FILE, direct light only."""
    print_header(["map, floor", "N", *floor_methods(1), "two-stage / MIS"])
    for name in floors or FLOORS:
        scenes = {
            sampler: floor_scene(file, FLOORS[name], not without_balls, size, sampler)
            for sampler in ("independent", SAMPLER)
        }
        pixels = shows_floor(scenes[SAMPLER])
        for count in counts:
            jobs = {
                method: (scenes[sampler], {**integrator, "max_depth": 2}, spp)
                for method, (sampler, integrator, spp) in floor_methods(count).items()
            }
            values = {
                method: float(np.sqrt(r.variance[pixels].mean()) / r.mean[pixels].mean())
                for method, r in render_in_turns(jobs, seeds).items()
            }
            least = min(value for method, value in values.items() if "two" in method)
            cells = [*(f"{value:.3f}" for value in values.values())]
            cells.append(f"{least / values['MIS']:.2f}")
            print_row([f"{Path(file).stem}, {name}", str(count), *cells])


if __name__ == "__main__":
    main()
