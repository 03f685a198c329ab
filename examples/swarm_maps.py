"""Draws the maps that ``swarm_path`` has learned for a few pixels of a scene (as
``learned_samples.py`` does for guiding):

``.venv/bin/python examples/swarm_maps.py scenes/paperweight.xml 60,110 200,75`` writes
``swarm_maps.png``: the image with the pixels marked, and for each of them the density of every
number that has a map, relative to uniform numbers.
"""

from __future__ import annotations

from pathlib import Path

import click
import numpy as np
from matplotlib import pyplot as plt
from matplotlib.patches import Rectangle

import mitsuba_ext  # noqa: F401  (before mitsuba: it chooses the LLVM library)

import mitsuba as mi  # isort: skip

from mitsuba_ext.techniques.swarming.pixel_maps import PixelMap, light_probabilities, pixel_maps

#: Labels of the axes of the plots, by slot, in the order of the columns.
_LABELS = {
    "time": ("time", "density"),
    "aperture": ("first number", "second number"),
    "wavelength": ("number of the wavelength", "density"),
    "distance": ("number of the distance", "density"),
    "light_numbers": ("probability", ""),
    "directions": ("number of the lobe", "bounce, reflections"),
    "scattering": ("angle around z", "height"),
}

#: Colours of the marked pixels.
_COLOURS = ("tab:orange", "tab:cyan", "tab:pink", "tab:green", "tab:red")


class Pixel(click.ParamType):
    """A pixel, as ``X,Y``."""

    name = "x,y"

    def convert(self, value, param, ctx):
        try:
            x, y = map(int, value.split(","))
        except ValueError:
            self.fail(f"{value} is not of the form X,Y", param, ctx)
        return x, y


def _draw_lights(axes: plt.Axes, found: PixelMap, scene: mi.Scene, most: int = 9) -> None:
    """Draws bars for the lights that are chosen most often, and the probability without a map."""
    probability, emitters = light_probabilities(scene, found), scene.emitters()
    shown = np.sort(np.argsort(-probability, kind="stable")[:most])[::-1]
    before = 1 / len(emitters)
    axes.barh(range(len(shown)), probability[shown], color="tab:blue")
    axes.axvline(before, color="gray", linewidth=0.8)
    names = [_name(emitters[i], i) for i in shown]
    axes.set_yticks(range(len(shown)), names, fontsize=6)


def _name(emitter: mi.Emitter, index: int) -> str:
    name = emitter.id()
    return f"light {index}" if name.startswith("_") or not name else name


def _draw_lobes(axes: plt.Axes, found: PixelMap) -> None:
    """Draws a row for each bounce and number of reflections before it."""
    bounces, reflections, _ = found.density.shape
    rows = [(b, r) for b in range(bounces) for r in range(reflections)]
    # Before bounce b there were at most b reflections
    rows = [(b, r) for b, r in rows if r <= b]
    density = np.stack([found.density[b, r] for b, r in rows])
    edges = found.edges[0]
    # From the first edge on, edges grow by a factor
    x = np.concatenate([[edges[1] / 2], edges[1:]])
    logarithm = np.log2(np.maximum(density, 2.0**-4))
    axes.pcolormesh(
        x, np.arange(len(rows) + 1), logarithm, cmap="RdBu_r", vmin=-4, vmax=4, rasterized=True
    )
    axes.set_xscale("log")
    ticks = [i for i, (_, r) in enumerate(rows) if r == 0]
    axes.set_yticks([i + 0.5 for i in ticks], [f"{rows[i][0] + 1}, 0" for i in ticks], fontsize=6)
    axes.invert_yaxis()


def _draw(axes: plt.Axes, slot: str, found: PixelMap, scene: mi.Scene) -> None:
    if slot == "light_numbers":
        _draw_lights(axes, found, scene)
    elif slot == "directions":
        _draw_lobes(axes, found)
    elif len(found.edges) == 2:
        axes.imshow(
            found.density.T, origin="lower", extent=(0, 1, 0, 1), cmap="magma", aspect="auto"
        )
        if slot == "scattering":  # up is up
            axes.invert_yaxis()
    else:
        axes.stairs(found.density, found.edges[0], fill=True)
        axes.axhline(1, color="gray", linewidth=0.8)
        axes.set_xlim(0, 1)
    xlabel, ylabel = _LABELS[slot]
    axes.set_xlabel(xlabel, fontsize=7)
    axes.set_ylabel(ylabel, fontsize=7)
    axes.tick_params(labelsize=6)


def figure_of(
    scene: mi.Scene, integrator: mi.Integrator, image: np.ndarray, pixels: list[tuple[int, int]]
) -> plt.Figure:
    """Draws the figure of a render: the image, and a row of maps for each pixel."""
    sensor = scene.sensors()[0]
    maps = [pixel_maps(integrator.learners, sensor, x, y) for x, y in pixels]
    slots = [slot for slot in _LABELS if any(slot in found for found in maps)]
    if not slots:
        raise click.ClickException("no map pays in this scene (try --always)")
    rows, columns = len(pixels), len(slots)
    height = image.shape[0] / image.shape[1] * 5
    figure = plt.figure(
        figsize=(5 + 1.6 * columns, max(height + 0.3, 1.55 * rows)), layout="constrained"
    )
    left, right = figure.subfigures(1, 2, width_ratios=(5, 1.6 * columns))
    axes = left.subplots()
    axes.imshow(np.clip(image, 0, 1) ** (1 / 2.2))
    axes.set_axis_off()
    grid = right.subplots(rows, columns, squeeze=False)
    for (x, y), found, row, colour in zip(pixels, maps, grid, _COLOURS * rows):
        axes.add_patch(Rectangle((x - 4, y - 4), 8, 8, fill=False, color=colour, linewidth=1.5))
        for slot, plot in zip(slots, row):
            if slot in found:
                _draw(plot, slot, found[slot], scene)
            else:
                plot.set_axis_off()
        row[0].set_ylabel(f"{x}, {y}", color=colour, fontsize=9, fontweight="bold")
    for slot, plot in zip(slots, grid[0]):
        plot.set_title(next(found[slot].name for found in maps if slot in found), fontsize=9)
    return figure


@click.command()
@click.argument("scene", type=click.Path(exists=True, path_type=Path))
@click.argument("pixels", type=Pixel(), nargs=-1, required=True)
@click.option("--spp", default=64, show_default=True, help="Samples per pixel of the render.")
@click.option("--max-depth", default=8, show_default=True)
@click.option("--variant", default="llvm_ad_rgb", show_default=True)
@click.option("--directions/--no-directions", default=False, help="Also maps of directions?")
@click.option("--always", is_flag=True, help="Show also maps that do not pay.")
@click.option("--out", type=click.Path(path_type=Path), default="swarm_maps.png")
def main(
    scene: Path, pixels: list[tuple[int, int]], spp: int, max_depth: int, variant: str,
    directions: bool, always: bool, out: Path,
) -> None:  # fmt: skip
    """Renders SCENE and draws the maps of the PIXELS, each as X,Y."""
    mi.set_variant(variant)
    mi.set_log_level(mi.LogLevel.Warn)
    loaded = mi.load_file(str(scene))
    integrator = mi.load_dict({
        "type": "swarm_path", "max_depth": max_depth, "always_use": always,
        "direction_map": directions,
    })  # fmt: skip
    image = np.array(mi.TensorXf(mi.render(loaded, integrator=integrator, spp=spp)))[..., :3]
    print(integrator.statistics.learned)
    figure_of(loaded, integrator, image, list(pixels)).savefig(out, dpi=110)
    print(out)


if __name__ == "__main__":
    main()
