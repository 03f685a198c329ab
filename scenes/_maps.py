"""Procedural textures and skies of the scenes, and how they are written."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import OpenEXR
from _geometry import Floats


def planks() -> Floats:
    """Floorboards, 2 x 2 m at 256 x 256: sixteen boards side by side, each with its own tint."""
    draw = np.random.Generator(np.random.PCG64(3))
    y, x = np.mgrid[0:256, 0:256]
    board = y // 16
    start = draw.integers(0, 256, 16)[board]
    piece = ((x + start) % 256) // 128
    tint = (0.75 + 0.45 * draw.random((16, 2)))[board, piece]
    grain = np.repeat(draw.random((256, 32)), 8, axis=1)
    grain = (np.roll(grain, 3, axis=1) + grain + np.roll(grain, -3, axis=1)) / 3
    seam = (y % 16 == 0) | ((x + start) % 128 == 0)
    value = tint * (0.9 + 0.2 * grain) * np.where(seam, 0.45, 1)
    return value[..., None] * np.array([0.36, 0.2, 0.1])


def painting() -> Floats:
    """Three hills, a sky and a moon, 192 x 128."""
    y, x = np.mgrid[0:128, 0:192]
    u, v = (x + 0.5) / 192, (y + 0.5) / 128
    below, above = np.array([0.75, 0.42, 0.2]), np.array([0.1, 0.22, 0.38])
    sky = below * v[..., None] + above * (1 - v[..., None])
    moon = np.hypot(u - 0.68, (v - 0.3) / 1.5) < 0.085
    image = np.where(moon[..., None], [0.9, 0.8, 0.55], sky)
    hills = [(0.52, 0.09, 5, 0.4, (0.28, 0.22, 0.3)), (0.66, 0.07, 7, 2.2, (0.14, 0.18, 0.2))]
    for base, swing, waves, phase, colour in hills + [(0.8, 0.06, 4, 4.0, (0.05, 0.09, 0.08))]:
        ridge = base + swing * np.sin(waves * u + phase)
        image = np.where((v > ridge)[..., None], colour, image)
    return image[::-1]  # the first row is the lower edge of a rectangle


def checker() -> Floats:
    """Two greys, 64 x 64, eight fields a side."""
    y, x = np.mgrid[0:64, 0:64]
    return np.where(((x // 8 + y // 8) % 2 == 0)[..., None], [0.55, 0.5, 0.44], [0.12, 0.14, 0.17])


def tiles() -> Floats:
    """Glazed tiles in blues, 128 x 128: eight tiles a side, with bright joints."""
    draw = np.random.Generator(np.random.PCG64(11))
    y, x = np.mgrid[0:128, 0:128]
    tone = draw.random((8, 8))[y // 16, x // 16, None]
    shade = (0.85 + 0.3 * draw.random((8, 8)))[y // 16, x // 16, None]
    tile = shade * (tone * np.array([0.36, 0.7, 0.72]) + (1 - tone) * np.array([0.2, 0.55, 0.68]))
    return np.where(((x % 16 == 0) | (y % 16 == 0))[..., None], [0.75, 0.77, 0.75], tile)


def sky(
    colours: tuple, elevation_of_sun: float, u: float, sun: tuple, glow: tuple, sharpness: float
) -> Floats:
    """512 x 256, latitude-longitude: a gradient from horizon to zenith, plain ground, and a sun of
    2 x 2 texels at (u, elevation in degrees) with a glow around it."""
    elevation = np.pi / 2 - np.pi * (np.arange(256) + 0.5) / 256
    up = np.sin(elevation)[:, None, None]
    horizon, zenith, ground = np.array(colours)
    gradient = zenith + (horizon - zenith) * np.exp(-3.5 * np.maximum(up, 0))
    image = np.repeat(np.where(up > 0, gradient, ground), 512, axis=1)
    azimuth = 2 * np.pi * ((np.arange(512) + 0.5) / 512 - u)
    height = np.radians(elevation_of_sun)
    near = np.cos(elevation)[:, None] * np.cos(azimuth) * np.cos(height)
    near = near + np.sin(elevation)[:, None] * np.sin(height)
    image += (np.exp(sharpness * (near - 1)))[..., None] * np.array(glow)
    row, column = int(256 * (90 - elevation_of_sun) / 180), int(512 * u)
    image[row : row + 2, column : column + 2] = sun
    return image


def sunny_sky() -> Floats:
    """The sky of sunny_gloss.xml: its sun stands 39 degrees high.

    Its four texels of 1e4 cause an irradiance of 4.7 on a plane that faces the sun; on the ground,
    about four times the irradiance of the rest of the sky.
    """
    colours = ((0.5, 0.58, 0.7), (0.09, 0.18, 0.42), (0.33, 0.28, 0.23))
    sun = np.array([1.15, 1.0, 0.8]) * 1e4
    return sky(colours, 39, 0.32, sun, (1.6, 1.3, 0.9), 60)


def clear_sky() -> Floats:
    """The sky of window.xml: a sun in the south-west, 33 degrees high, over dark ground."""
    colours = ((0.65, 0.75, 0.9), (0.2, 0.42, 0.95), (0.1, 0.09, 0.07))
    sun = np.array([1.15, 1.0, 0.8]) * 3e4
    return sky(colours, 33, 0.625, sun, (4, 3.4, 2.6), 60)


def hall() -> Floats:
    """The hall around showroom.xml, 512 x 256, latitude-longitude: dark, with 60 lamps of one to
    four texels, in four colours, that hang all around."""
    draw = np.random.Generator(np.random.PCG64(21))
    image = np.full((256, 512, 3), 0.02)
    tints = np.array([(1.0, 0.75, 0.45), (0.6, 0.8, 1.0), (1.0, 0.95, 0.85), (1.0, 0.5, 0.35)])
    for row, count in ((36, 8), (56, 14), (76, 18), (96, 20)):
        for number in range(count):
            column = int((number + 0.6 * draw.random()) * 512 / count)
            height, width = draw.integers(1, 3, 2)
            colour = tints[draw.integers(len(tints))] * (0.5 + draw.random())
            place = slice(row, row + height), np.arange(column, column + width) % 512
            image[place] = colour * 1000 / (height * width)
    return image


def dunes() -> Floats:
    """Heights of sand dunes with ripples, between 0 and 1: steep on one side of their crests."""
    count = 320
    y, x = np.mgrid[:count, :count] / (count - 1)
    bend = 0.09 * np.sin(5 * y + 1) + 0.05 * np.sin(11 * y + 3 * x) + 0.02 * np.sin(23 * y - 7 * x)
    phase = (2.6 * (x + bend) + 0.3 * y) % 1
    # Up with the wind over two thirds of the way, then down
    rise = np.where(phase < 0.68, phase / 0.68, (1 - phase) / 0.32)
    crest = 0.5 - 0.5 * np.cos(np.pi * rise)
    height = crest * (0.55 + 0.3 * np.sin(4 * y + 2 * x) + 0.15 * np.sin(9 * x + 1))
    ripples = 0.011 * np.sin(330 * (x + 0.4 * bend) + 12 * np.sin(6 * y)) * (1 - crest)
    return 0.05 + 0.9 * height + ripples


def write_exr(path: Path, image: Floats) -> None:
    """Writes linear half floats, rounded to a thousandth: repeatable, and smaller files."""
    header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
    name = "Y" if image.ndim == 2 else "RGB"
    with OpenEXR.File(header, {name: np.round(image, 3).astype(np.float16)}) as exr:
        exr.write(str(path))
