"""Compares ``path``, ``bdpt`` and Metropolis integrators at equal numbers of samples and mutations,
by variance and CPU time, start-up included:

    .venv/bin/python examples/metropolis.py caustic ring /somewhere/scene.xml --size 192 108

Writes one row of Markdown for each scene. Errors are those of ``examples/equal_samples.py``,
relative to the mean of all images of ``pssmlt``; times are the median of the seeds. The efficiency,
1 / (error · time), is relative to ``path``. ``means`` has those of ``path`` and ``bdpt``, relative
to that of ``pssmlt``: where they are below 1, light is found too rarely for the variance to tell
the error.
"""

from __future__ import annotations

from equal_samples import (
    Renders,
    error,
    load,
    options,
    print_header,
    print_row,
    render_in_turns,
    title,
)

import click  # isort: skip
import mitsuba as mi  # isort: skip

INTEGRATORS = {
    "path": {"type": "path"},
    "bdpt": {"type": "bdpt"},
    "pssmlt": {"type": "pssmlt"},
    "pssmlt, path": {"type": "pssmlt", "bidirectional": False},
    "erpt": {"type": "erpt", "bidirectional": True},
    "erpt, path": {"type": "erpt"},
}

COLUMNS = ["scene", "`path`: seconds", "error", "means"]
for _kind in list(INTEGRATORS)[1:]:
    COLUMNS += [f"{_kind}: time", "error", "efficiency"]
COLUMNS.append("accepted")


@click.command()
@options
def main(names: tuple[str, ...], max_depth: int, spp: int, seeds: int, size: tuple) -> None:
    """Compares the integrators on the scenes NAMES."""
    mi.set_variant("llvm_ad_rgb")
    mi.set_log_level(mi.LogLevel.Error)
    print_header(COLUMNS)
    for name in names:
        renders = render_in_turns(load(name, size), INTEGRATORS, max_depth, spp, seeds)
        print_row([title(name), *cells(renders)])


def cells(renders: dict[str, Renders]) -> list[str]:
    path, mean = renders["path"], renders["pssmlt"].mean
    base = error(path.variance, mean)
    means = [renders[kind].mean.mean() / mean.mean() for kind in ("path", "bdpt")]
    row = [f"{path.time:.1f}", f"{base:.2g}", ", ".join(f"{m:.3f}" for m in means)]
    for kind in list(INTEGRATORS)[1:]:
        slower = renders[kind].time / path.time
        e = error(renders[kind].variance, mean) / base
        row += [f"{slower:.2f}", f"{e:.2g}", f"{1 / (e * slower):.2g}"]
    return [*row, renders["pssmlt"].learned[-1].removeprefix("accepted: ")]


if __name__ == "__main__":
    main()
