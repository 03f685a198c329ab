"""Compares weighted points with other estimators on integrals whose value is known.

The plots follow Figs. 4.2 to 4.4 of Guo's PhD thesis: its function of one variable, a picture,
other functions, densities that are not uniform, and batches. ``benchmarks/reweighting.py`` writes
them to ``docs/figures``, and prints tables (about three minutes). With ``--bias``, it measures
instead by how many standard errors the estimators from independent points are off (half an hour).
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterator
from pathlib import Path

import click
import matplotlib.pyplot as plt
import numpy as np
from scipy import integrate, ndimage

from mitsuba_ext.util.pointsets import (
    nearest_neighbour_weights,
    piecewise_points,
    piecewise_weights,
    points,
    shifted,
    tent,
    trapezoid_weights,
    unbiased_weights,
    voronoi_weights,
)

FIGURES = Path(__file__).parents[1] / "docs" / "figures"

#: Test points of the nearest-neighbour rule, for each point.
TESTS = 16

# ---- Integrands ----


def thesis_function(x: np.ndarray) -> np.ndarray:
    """Thesis, section 4.5.1. It is 0 at both ends."""
    x = np.asarray(x, float)
    pieces = [
        (0.25, lambda x: np.sqrt(-(x**2) + 0.5 * x)),
        (0.50, lambda x: -np.sqrt(-(x**2) + x - 0.1875) + 0.25),
        (0.55, lambda x: 20 * (x - 0.5)),
        (0.65, lambda x: np.ones_like(x)),
        (0.70, lambda x: -20 * (x - 0.7)),
        (0.80, lambda x: 0.1 * np.sin(10 * np.pi * (x - 0.7))),
        (0.90, lambda x: 0.25 * np.sin(10 * np.pi * (x - 0.8))),
        (1.00, lambda x: 0.5 * np.sin(10 * np.pi * (x - 0.9))),
    ]
    result, low = np.zeros_like(x), -1.0
    for high, piece in pieces:
        chosen = (x > low) & (x <= high)
        result[chosen] = 10 * piece(x[chosen])
        low = high
    return result


def picture(size: int = 512) -> np.ndarray:
    """A grey picture: a shaded ball over stripes, a dark frame on one side, and some grain."""
    y, x = (np.mgrid[:size, :size] + 0.5) / size
    image = 0.35 + 0.25 * np.sin(40 * (x + 0.4 * y)) * y + 0.2 * y
    r2 = (x - 0.55) ** 2 + (y - 0.45) ** 2
    ball = r2 < 0.08
    image[ball] = 0.15 + 0.85 * np.sqrt(1 - r2[ball] / 0.08) * (1.2 - x[ball] - 0.4 * y[ball])
    image[x < 0.12 + 0.05 * y] = 0.05
    grain = np.random.default_rng(1).random((size, size))
    return image + 0.15 * ndimage.gaussian_filter(grain - 0.5, 4) * 10


_PICTURE = picture()


def picture_function(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """The value of the nearest pixel."""
    size = len(_PICTURE)
    row, column = (np.minimum((u * size).astype(int), size - 1) for u in (y, x))
    return _PICTURE[row, column]


def _integral(f: Callable) -> float:
    breaks = [0.25, 0.5, 0.55, 0.65, 0.7, 0.8, 0.9]
    return integrate.quad(f, 0, 1, points=breaks, limit=500, epsabs=1e-13)[0]


LINE: dict[str, tuple[Callable, float]] = {
    "thesis": (thesis_function, _integral(lambda x: float(thesis_function(np.array([x]))[0]))),
    "exp": (np.exp, np.e - 1),
    "sine": (lambda x: 1 + np.sin(2 * np.pi * x), 1.0),
    "peak": (lambda x: 1 / (1 + 25 * (2 * x - 1) ** 2), np.arctan(5) / 5),
    "root": (np.sqrt, 2 / 3),
    "step": (lambda x: (x < 0.7).astype(float), 0.7),
}
SQUARE: dict[str, tuple[Callable, float]] = {
    "picture": (picture_function, float(_PICTURE.mean())),
    "exp": (lambda x, y: np.exp(x + y), (np.e - 1) ** 2),
    "sine": (lambda x, y: (1 + np.sin(2 * np.pi * x)) * (1 + np.sin(2 * np.pi * y)), 1.0),
    "disk": (lambda x, y: (x**2 + y**2 < 0.8).astype(float), np.pi * 0.2),
}

# ---- Estimators: points and their weights ----

Sets = Iterator[tuple[str, np.ndarray, np.ndarray]]


def line_sets(count: int, rng: np.random.Generator) -> Sets:
    """(name, points, weights) of all estimators of one variable."""
    plain = np.full(count, 1 / count)
    x = points("independent", count, 1, rng)[:, 0]
    torus = voronoi_weights(x)
    yield "independent", x, plain
    yield "independent, cells", x, voronoi_weights(x, "clip")
    yield "independent, unbiased", x, unbiased_weights(x)
    yield "independent, torus", x, torus
    yield "independent, torus + tent", tent(x), torus
    weights, at_0, at_1 = trapezoid_weights(x)
    yield "independent, trapezoids", np.append(x, [0, 1]), np.append(weights, [at_0, at_1])
    tests = rng.random(TESTS * count)
    yield "independent, nearest neighbour", x, nearest_neighbour_weights(x, tests)
    x = points("stratified", count, 1, rng)[:, 0]
    yield "stratified", x, plain
    yield "stratified, cells", x, voronoi_weights(x, "clip")
    u = shifted(x, rng.random())
    yield "stratified, torus + tent", tent(u), voronoi_weights(u)
    for pattern in ("halton", "sobol", "lattice"):
        yield pattern, points(pattern, count, 1, rng)[:, 0], plain


def square_sets(count: int, rng: np.random.Generator) -> Sets:
    """(name, points, weights) of all estimators of two variables."""
    plain = np.full(count, 1 / count)
    for pattern in ("independent", "stratified", "sobol"):
        x = points(pattern, count, 2, rng)
        yield pattern, x, plain
        yield f"{pattern}, cells", x, voronoi_weights(x, "clip")
        u = x if pattern == "independent" else shifted(x, rng.random(2))
        weights = voronoi_weights(u)
        yield f"{pattern}, torus", u, weights
        yield f"{pattern}, torus + tent", tent(u), weights
    for pattern in ("latin_hypercube", "halton", "hammersley", "lattice"):
        yield pattern, points(pattern, count, 2, rng), plain


def unbiased_line_sets(count: int, rng: np.random.Generator) -> Sets:
    """(name, points, weights) of the weighted estimators of one variable that are unbiased."""
    x = points("independent", count, 1, rng)[:, 0]
    yield "independent, unbiased", x, unbiased_weights(x)
    torus = voronoi_weights(x)
    yield "independent, torus", x, torus
    yield "independent, torus + tent", tent(x), torus
    u = shifted(points("stratified", count, 1, rng)[:, 0], rng.random())
    yield "stratified, torus + tent", tent(u), voronoi_weights(u)


def unbiased_square_sets(count: int, rng: np.random.Generator) -> Sets:
    """The same for two variables."""
    for pattern in ("independent", "stratified"):
        u = shifted(points(pattern, count, 2, rng), rng.random(2))
        torus = voronoi_weights(u)
        yield f"{pattern}, torus", u, torus
        yield f"{pattern}, torus + tent", tent(u), torus


def errors(
    make: Callable[[int, np.random.Generator], Sets],
    functions: dict[str, tuple[Callable, float]],
    counts: list[int],
    repetitions: int,
) -> dict[str, dict[str, np.ndarray]]:
    """For each function and each estimator, the errors, of shape (counts, repetitions)."""
    result: dict[str, dict[str, np.ndarray]] = {name: {} for name in functions}
    for row, count in enumerate(counts):
        rng = np.random.default_rng(count)
        for column in range(repetitions):
            for estimator, x, weights in make(count, rng):
                for name, (f, integral) in functions.items():
                    table = result[name].setdefault(
                        estimator, np.zeros((len(counts), repetitions))
                    )
                    value = f(x) if x.ndim == 1 else f(*x.T)
                    table[row, column] = weights @ value - integral
    return result


# ---- Tables and plots ----


def report(title: str, tables: dict[str, dict[str, np.ndarray]], counts: list[int]) -> None:
    """Prints, for each function and estimator, the MSE, its slope over the last three quarters of
    the counts, and by which factor fewer samples than with plain Monte Carlo have the same MSE."""
    for name, estimators in tables.items():
        plain = np.mean(estimators["independent"] ** 2, axis=1) * counts
        click.echo(f"\n{title}, {name}: MSE at N = {counts[-1]}, slope, samples saved")
        for estimator, table in estimators.items():
            mse = np.mean(table**2, axis=1)
            part = slice(len(counts) // 4, None)
            slope = np.polyfit(np.log(counts[part]), np.log(mse[part]), 1)[0]
            saved = plain.mean() / mse / counts
            click.echo(
                f"  {estimator:32s} {mse[-1]:8.1e} {slope:6.2f}  "
                + " ".join(f"{n}: {s:.3g}" for n, s in zip(counts, saved) if n in (64, 1024))
            )


def plot(title: str, tables: dict[str, dict[str, np.ndarray]], counts: list[int]) -> None:
    """One panel for each function."""
    columns = min(3, len(tables))
    rows = -(-len(tables) // columns)
    figure, axes = plt.subplots(rows, columns, figsize=(5 * columns, 4.2 * rows), squeeze=False)
    for panel, (name, estimators) in zip(axes.flat, tables.items()):
        for index, (estimator, table) in enumerate(estimators.items()):
            style = "-" if "," in estimator else "--"
            panel.loglog(counts, np.mean(table**2, axis=1), style, c=f"C{index % 10}",
                         lw=1 + index // 10, label=estimator)  # fmt: skip
        panel.set(title=name, xlabel="N", ylabel="MSE")
        # Smaller errors are rounding errors
        panel.set_ylim(bottom=max(1e-20, panel.get_ylim()[0]))
    figure.tight_layout()
    handles, labels = axes.flat[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="lower center", ncols=5, fontsize=8)
    figure.subplots_adjust(bottom=0.24 / rows + 0.06)
    FIGURES.mkdir(exist_ok=True)
    figure.savefig(FIGURES / f"reweighting_{title}.svg")
    plt.close(figure)


def densities(counts: list[int], repetitions: int) -> dict[str, dict[str, np.ndarray]]:
    """Fig. 4.2: the thesis's function, from piecewise constant densities: four pieces that do not
    match it, and ten that do."""
    f, integral = LINE["thesis"]
    fine = np.abs(f((np.arange(1000) + 0.5) / 1000)).reshape(10, 100).mean(axis=1)
    pieces = {
        "4 pieces": (np.linspace(0, 1, 5), np.array([0.1, 0.4, 0.2, 0.3])),
        "10 pieces": (np.linspace(0, 1, 11), fine / fine.sum()),
    }
    result: dict[str, np.ndarray] = {}

    def put(name: str, row: int, column: int, estimate: float) -> None:
        table = result.setdefault(name, np.zeros((len(counts), repetitions)))
        table[row, column] = estimate - integral

    for (row, count), column in itertools.product(enumerate(counts), range(repetitions)):
        rng = np.random.default_rng([count, column])
        u = rng.random(count)
        put("independent", row, column, f(u).mean())
        put("independent, unbiased", row, column, unbiased_weights(u) @ f(u))
        for name, (edges, probabilities) in pieces.items():
            x = piecewise_points(u, edges, probabilities)
            piece = np.searchsorted(edges, x, side="right").clip(1, len(probabilities)) - 1
            density = (probabilities / np.diff(edges))[piece]
            put(name, row, column, (f(x) / density).mean())
            weights = piecewise_weights(x, edges, probabilities)
            put(f"{name}, unbiased", row, column, weights @ f(x))
    return {"densities": result}


def batches(total: int, sizes: list[int], repetitions: int) -> dict[str, dict[str, np.ndarray]]:
    """Fig. 4.3 (b): errors of the mean over batches, for the same number of samples in batches of
    several sizes. With biased estimators, many small batches do not reduce the error."""
    f, integral = LINE["exp"]
    result: dict[str, np.ndarray] = {}
    for (row, size), column in itertools.product(enumerate(sizes), range(repetitions)):
        rng = np.random.default_rng([size, column])
        sums: dict[str, list[float]] = {}
        for _ in range(total // size):
            for name, x, weights in line_sets(size, rng):
                sums.setdefault(name, []).append(float(weights @ f(x)))
        for name, values in sums.items():
            table = result.setdefault(name, np.zeros((len(sizes), repetitions)))
            table[row, column] = np.mean(values) - integral
    return {"batches": result}


def bias(repetitions: int) -> None:
    """Prints by how many standard errors the means of the unbiased estimators are off."""
    parts = (("line", unbiased_line_sets, LINE), ("square", unbiased_square_sets, SQUARE))
    for title, make, functions in parts:
        worst: dict[str, float] = {}
        for count in (2, 3, 4, 16, 64, 256, 1024):
            for name, estimators in errors(make, functions, [count], repetitions).items():
                for estimator, table in estimators.items():
                    e = table[0]
                    spread = e.std(ddof=1) / np.sqrt(len(e))
                    # Without noise, the error is a rounding error
                    z = abs(e.mean()) / spread if spread > 1e-15 else 0.0
                    worst[estimator] = max(z, worst.get(estimator, 0.0))
                    click.echo(f"{title} {name:8s} N = {count:4d} {estimator:32s} {z:7.1f}")
        click.echo(f"\n{title}, largest of all:")
        for estimator, z in worst.items():
            click.echo(f"  {estimator:32s} {z:7.1f}")


@click.command()
@click.option("--repetitions", default=100, show_default=True)
@click.option("--bias", "only_bias", is_flag=True, help="Measure bias (1000 times as many runs).")
def main(repetitions: int, only_bias: bool) -> None:
    """Compares estimators of integrals."""
    if only_bias:
        bias(1000 * repetitions)
        return
    counts = [2**k for k in range(2, 13)]
    parts = [
        ("line", errors(line_sets, LINE, counts, repetitions), counts),
        ("square", errors(square_sets, SQUARE, counts[:9], repetitions), counts[:9]),
        ("densities", densities(counts, repetitions), counts),
        ("batches", batches(4096, counts, max(8, repetitions // 8)), counts),
    ]
    for title, tables, sizes in parts:
        plot(title, tables, sizes)
        report(title, tables, sizes)


if __name__ == "__main__":
    main()
