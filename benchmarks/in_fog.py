"""Writes a copy of a scene that is filled with fog: ``benchmarks/in_fog.py scenes/rooms.xml 0.05``
writes scenes/rooms_in_fog.xml, beside the original, whose files it needs."""

from __future__ import annotations

import re
from pathlib import Path

import click

#: The fog ends in a ball that holds the camera and all things, but not the sky.
_FOG = """
    <medium type="homogeneous" id="in_fog">
        <float name="sigma_t" value="{extinction}"/>
        <float name="albedo" value="{albedo}"/>
        <phase type="hg"><float name="g" value="{g}"/></phase>
    </medium>
    <shape type="sphere">
        <float name="radius" value="{radius}"/>
        <bsdf type="null"/>
        <ref name="interior" id="in_fog"/>
    </shape>
"""

#: Clear air around the camera, for integrators whose camera cannot be in a medium.
_BUBBLE = """
    <shape type="sphere">
        <point name="center" value="{origin}"/>
        <float name="radius" value="{clear}"/>
        <bsdf type="null"/>
        <ref name="exterior" id="in_fog"/>
    </shape>
"""


@click.command()
@click.argument("scene", type=click.Path(exists=True, path_type=Path))
@click.argument("extinction", type=float)
@click.option("--albedo", default=0.9, help="Share of the light that scattering keeps.")
@click.option("--g", default=0.3, help="Mean cosine of the angle by which it scatters.")
@click.option("--radius", default=60.0, help="Of the ball of fog around the origin.")
@click.option("--clear", default=0.0, help="Radius of a ball of clear air around the camera.")
def main(
    scene: Path, extinction: float, albedo: float, g: float, radius: float, clear: float
) -> None:
    """Fills SCENE with fog of this EXTINCTION per unit of length."""
    text = scene.read_text()
    head, sensor, rest = text.partition("<sensor ")
    if not sensor:
        raise click.ClickException(f"{scene} has no sensor")
    opening, _, inside = rest.partition(">")
    fog = _FOG.format(extinction=extinction, albedo=albedo, g=g, radius=radius)
    around = '\n        <ref name="medium" id="in_fog"/>'
    if clear:
        (origin,) = re.findall(r'origin="([^"]*)"', inside)
        fog, around = fog + _BUBBLE.format(origin=origin, clear=clear), ""
    text = f"{head}{fog}    {sensor}{opening}>{around}{inside}"
    target = scene.with_name(f"{scene.stem}_in_fog.xml")
    target.write_text(text)
    print(target)


if __name__ == "__main__":
    main()
