"""Reading photometric files (IES LM-63), which hold intensities by angle."""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path

import numpy as np

#: The vertical angles 0 … 90 and horizontal angles 0 … 360 of the table, in degrees.
_VERTICAL, _HORIZONTAL = np.linspace(0, 90, 181), np.linspace(0, 360, 145)


@dataclass
class Intensities:
    """The intensity of a luminaire in its front half space, divided by the largest intensity.

    Attributes:
        values: Shape [horizontal, vertical]: horizontal angles from 0° to 360°, both included, or a
            single row if the intensity does not depend on them; vertical angles from 0° (straight
            ahead) to 90°. Steps are regular.
    """

    values: np.ndarray


def read_ies(file: Path) -> Intensities:
    """Reads a photometric file of type C, which almost all luminaires use.

    Raises:
        ValueError: The file is damaged or of another type, or the luminaire does not shine into its
            front half space.
    """
    text = file.read_text(encoding="latin-1")
    parts = re.split(r"^TILT *= *(\S+).*$", text, maxsplit=1, flags=re.MULTILINE)
    if len(parts) != 3:
        raise ValueError(f"{file}: not a photometric file (IES LM-63): it has no line TILT=")
    try:
        numbers = np.array(parts[2].replace(",", " ").split(), dtype=np.float64)
        if parts[1] == "INCLUDE":
            # Skip the factors for tilted lamps: the lamp's position, a count, and pairs
            numbers = numbers[2 + 2 * int(numbers[1]) :]
        vertical_count, horizontal_count, kind = (int(n) for n in numbers[3:6])
        angles = numbers[13 : 13 + vertical_count + horizontal_count]
        vertical, horizontal = angles[:vertical_count], angles[vertical_count:]
        values = numbers[13 + len(angles) :][: vertical_count * horizontal_count]
        values = values.reshape(horizontal_count, vertical_count)
    except (ValueError, IndexError) as error:
        raise ValueError(f"{file}: the numbers of this photometric file cannot be read") from error
    if kind != 1:
        raise ValueError(f"{file}: photometry of type {kind}; only type C (1) is supported")
    if len(vertical) < 2 or len(horizontal) < 1 or np.any(np.diff(vertical) <= 0):
        raise ValueError(f"{file}: vertical angles must increase")
    table = np.stack([np.interp(_VERTICAL, vertical, row, left=0, right=0) for row in values])
    if not table.max(initial=0) > 0 or table.min() < 0:
        raise ValueError(f"{file}: the luminaire does not shine between 0° and 90°")
    table /= table.max()
    if len(horizontal) == 1:
        return Intensities(table)
    # Files give a quarter or a half of the circle if the rest is symmetric
    turn = _HORIZONTAL.copy()
    if horizontal[-1] <= 180:
        turn = np.minimum(turn, 360 - turn)
    if horizontal[-1] <= 90:
        turn = np.minimum(turn, 180 - turn)
    columns = [np.interp(turn, horizontal, column) for column in table.T]
    return Intensities(np.stack(columns, axis=1))
