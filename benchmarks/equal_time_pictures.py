"""Renders pairs of pictures at equal time: ``path`` beside an integrator of ours.

    python benchmarks/equal_time_pictures.py            # those of the plugins' pages
    python benchmarks/equal_time_pictures.py --readme   # those of the README

Kernels are compiled before. ``path`` is rendered by ``composed_path`` with its defaults, which
makes the same image and ends at a timeout. Both halves have one exposure: that of our image. The
errors under the pictures are measured with the references that ``references.py`` has rendered.
"""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any, NamedTuple

import click
import numpy as np
from equal_samples import SCENES, load
from PIL import Image, ImageDraw
from previews import WIDTHS
from references import stored

from mitsuba_ext.compare.references import load_reference
from mitsuba_ext.images.metrics import errors

import mitsuba as mi  # isort: skip

DOCS = Path(__file__).parents[1] / "docs"


class Pair(NamedTuple):
    """A scene, an integrator of ours, and what stands beside it.

    Attributes:
        sampler: Replaces that of the scene, for ours; see :func:`equal_samples.load`.
        beside: The scene of ``path``, if it is another one.
        label: What our picture is called, if not by its integrator.
        seconds: For each render, if not those of the command.
    """

    scene: str
    ours: dict[str, Any]
    sampler: str = ""
    beside: str = ""
    label: str = ""
    seconds: float = 0.0


#: The pictures of the README, by scene.
README = {
    "rooms": Pair("rooms", {"type": "auto_path"}),
    "door_ajar": Pair("door_ajar", {"type": "auto_path"}),
    "glass_lamp": Pair("glass_lamp", {"type": "bdpt"}),
    "pool": Pair("pool", {"type": "vcm"}),
    "caustic": Pair("caustic", {"type": "bdpt"}),
}

#: ``path``, which ends at a timeout.
_PATH = {"type": "composed_path"}

#: The pictures of the plugins' pages. Integrators around others have them around ``path``.
PLUGINS = {
    "auto": Pair("water_glass", {"type": "auto"}),
    "auto_path": Pair("door_ajar", {"type": "auto_path"}),
    "neepp": Pair("rooms", {"type": "neepp"}),
    "pss_guided": Pair("corridor", {"type": "pss_guided"}),
    "swarm_path": Pair("colour_wheel", {"type": "swarm_path"}),
    "bdpt": Pair("glass_lamp", {"type": "bdpt"}),
    "vcm": Pair("pool", {"type": "vcm"}),
    "sppm": Pair("volume_caustic", {"type": "sppm"}),
    "photon_map": Pair("caustic", {"type": "photon_map"}),
    "instant_radiosity": Pair("door_ajar", {"type": "instant_radiosity"}),
    "irradiance_cache": Pair("window", {"type": "irradiance_cache"}),
    "light_tracer": Pair("ring", {"type": "light_tracer"}),
    "erpt": Pair("pool", {"type": "erpt"}),
    "pssmlt": Pair("pool", {"type": "pssmlt"}),
    "mlt": Pair("mirrored_lamp", {"type": "mlt"}),
    "composed_path": Pair(
        "many_lamps", {**_PATH, "next_event": "power"}, label="next_event=power"
    ),
    "reweighted_time": Pair("fast_balls", {"type": "reweighted_time", "nested": _PATH}),
    "reweighted_lens": Pair("defocus", {"type": "reweighted_lens", "nested": _PATH}),
    "ecoc_dof": Pair("defocus", {"type": "ecoc_dof", "nested": _PATH}),
    "adaptive": Pair("spotlights", {"type": "adaptive", "nested": _PATH}),
    # Decisions
    **{
        name: Pair(scene, {**_PATH, slot: {"type": name}}, label=name)
        for name, slot, scene in (
            ("guided_directions", "directions", "door_ajar"),
            ("learned_lights", "next_event", "rooms"),
            ("spatial_lights", "next_event", "many_lamps"),
            ("resampled_lights", "next_event", "spotlights"),
            ("two_stage_lights", "next_event", "colonnade"),
            ("portal_lights", "next_event", "portal_room"),
            ("visibility_roulette", "shadow_test", "rooms"),
            ("weighted_connections", "connections", "open"),
        )
    },
    # Samplers: few samples show what they do
    **{
        name: Pair("cornell_box", _PATH, sampler=name, label=name, seconds=0.7)
        for name in ("sobol_owen", "halton", "hammersley", "faure", "latin_hypercube", "lattice")
    },
    "solid_angle_area": Pair(
        "near_lights", _PATH, beside="near_lights:light=area", label="solid_angle_area"
    ),
}

#: Where the brightest values of our image come to lie, before the sRGB curve.
_WHITE = 0.9


def rendered(scene: mi.Scene, integrator: dict, seconds: float, max_depth: int):
    """The image, and the statistics: how many samples per pixel fit into the time."""
    inner = integrator.get("nested", integrator)
    timed = {**inner, "max_depth": max_depth}
    if "nested" in integrator:
        timed = {**integrator, "nested": timed}
    timed = mi.load_dict({**timed, "timeout": seconds})
    for seed in range(2):  # the first one compiles the kernels
        image = np.array(mi.render(scene, integrator=timed, spp=1 << 16, seed=seed))[..., :3]
    return image, timed.statistics


def side_by_side(pair: Pair, seconds: float, size: tuple[int, int]) -> tuple[Image.Image, str]:
    """Both pictures in one, and sentences about their samples and errors."""
    seconds = pair.seconds or seconds
    max_depth, own = int(_default(pair.scene, "max_depth")), _default(pair.scene, "rfilter")
    with_filter = f":rfilter={own}" if own else ""
    scene = load(pair.scene + with_filter, size, pair.sampler)
    beside = scene
    if pair.beside or pair.sampler:
        beside = load((pair.beside or pair.scene) + with_filter, size)
    label = pair.label or pair.ours["type"]
    made = {
        "path": rendered(beside, _PATH, seconds, max_depth),
        label: rendered(scene, pair.ours, seconds, max_depth),
    }
    scale = _WHITE / np.quantile([*made.values()][1][0], 0.98)
    picture = Image.new("RGB", (2 * size[0] + 4, size[1]), "white")
    for index, (label, (image, _)) in enumerate(made.items()):
        half = _to_8_bit(image, scale)
        ImageDraw.Draw(half).text((6, size[1] - 16), label, fill="white", stroke_width=1,
                                  stroke_fill="black")  # fmt: skip
        picture.paste(half, (index * (size[0] + 4), 0))
    figures = {"Samples per pixel": [str(statistics.spp) for _, statistics in made.values()]}
    if (file := stored(pair.scene)) is not None and size[0] == WIDTHS.get(pair.scene, 320):
        reference = load_reference(file, size)
        of_both = [errors(i, reference.mean, reference.variance) for i, _ in made.values()]
        figures["relMSE"] = [f"{e.relmse:.2g}" for e in of_both]
        figures["FLIP"] = [f"{e.flip:.2g}" for e in of_both]
    text = (
        f"{pair.scene}.xml, {size[0]}x{size[1]}, {seconds:g} s each on two cores, learning "
        "included. "
    ) + " ".join(
        f"{what}: {', '.join(f'{who} {value}' for who, value in zip(made, values))}."
        for what, values in figures.items()
    )
    return picture, text


def _default(scene: str, name: str) -> str:
    """The default value of a parameter of one of our scenes; empty if it has no such parameter."""
    text = (SCENES / f"{scene}.xml").read_text(encoding="utf-8")
    found = re.search(rf'<default name="{name}" value="([^"]*)"', text)
    return found[1] if found else ""


def _to_8_bit(image: np.ndarray, scale: float) -> Image.Image:
    linear = np.clip(image * scale, 0, 1)
    srgb = np.where(linear < 0.0031308, 12.92 * linear, 1.055 * linear ** (1 / 2.4) - 0.055)
    return Image.fromarray(np.round(255 * srgb).astype(np.uint8))


@click.command()
@click.argument("names", nargs=-1)
@click.option("--readme", is_flag=True, help="The pictures of the README.")
@click.option("--seconds", default=5.0, show_default=True, help="For each render.")
def main(names: tuple[str, ...], readme: bool, seconds: float) -> None:
    """Renders the pictures NAMES (all, if none is given)."""
    mi.set_variant("llvm_ad_rgb")
    pairs = README if readme else PLUGINS
    (DOCS / "pictures").mkdir(exist_ok=True)
    for name in names or pairs:
        # Those of the README stand beside each other
        width = 320 if readme else WIDTHS.get(pairs[name].scene, 320)
        picture, text = side_by_side(pairs[name], seconds, (width, 180))
        print(f"{name}: {text}", flush=True)
        if readme:
            picture.save(DOCS / "figures" / f"equal_time_{name}.jpg", quality=90)
        else:
            picture.save(DOCS / "pictures" / f"{name}.jpg", quality=85)
            (DOCS / "pictures" / f"{name}.txt").write_text(text + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
