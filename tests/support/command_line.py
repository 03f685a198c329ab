"""A small scene file for tests of the command line, and the command in another process."""

from __future__ import annotations

import subprocess
import sys

SCENE = """<scene version="3.0.0">
  <default name="spp" value="4"/>
  {integrator}
  <sensor type="perspective">
    <float name="fov" value="45"/>
    <film type="hdrfilm">
      <integer name="width" value="8"/>
      <integer name="height" value="6"/>
      <rfilter type="box"/>
      {film}
    </film>
    <sampler type="independent"><integer name="sample_count" value="$spp"/></sampler>
  </sensor>
  <emitter type="constant"/>
  {body}
</scene>
"""

SPHERE = """<shape type="sphere">
    <transform name="to_world"><translate z="5"/></transform>
    <bsdf type="diffuse"/>
  </shape>"""

PLAIN_PATH = '<integrator type="path"><integer name="max_depth" value="3"/></integrator>'

#: With a parameter of its own, it is not replaced by ``auto`` in ``mitsuba-ext render``.
PATH = PLAIN_PATH.replace("</", '<float name="timeout" value="-1"/></', 1)


def in_subprocess(*arguments, **options) -> subprocess.CompletedProcess:
    """Runs ``mitsuba-ext`` with these arguments in another process."""
    command = [sys.executable, "-m", "mitsuba_ext", *map(str, arguments)]
    return subprocess.run(command, capture_output=True, text=True, timeout=300, **options)
