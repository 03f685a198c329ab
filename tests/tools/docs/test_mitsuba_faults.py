"""The faults of Mitsuba that docs/mitsuba_faults.md describes are still there.

The page is the source: its first block of code is run before each of the others, and each line
``print(VALUE)  # FOUND ± TOLERANCE, not RIGHT`` is a claim. Blocks that begin with
```` ```python slow ```` are slow tests.
"""

from __future__ import annotations

import gc
import re
import sys
from ast import literal_eval
from pathlib import Path
from typing import NamedTuple

import mitsuba as mi
import pytest

from tests.support.paths import ROOT

pytestmark = pytest.mark.usefixtures("variant")

PAGE = ROOT / "docs" / "mitsuba_faults.md"

SECTION = re.compile(r"^## (?P<title>.+)\n(?P<text>(?:(?!## ).*\n)*)", re.M)
BLOCK = re.compile(r"^```python(?P<mark> slow)?\n(?P<code>(?:(?!```).*\n)*)```$", re.M)
CLAIM = re.compile(r"^ *print\(.+\)  # (\S+)(?: ± (\S+))?, not (\S+)$")
LINK = re.compile(r"\]\(\.\./([^)#]+)\)")


class Fault(NamedTuple):
    """A section of the page with a block of code."""

    title: str
    line: int  # where the code begins on the page
    code: str
    files: list[str]
    is_slow: bool

    def claim(self, line: int) -> tuple[float, float, float]:
        """The claim at that line of the page: the value found in Mitsuba, its tolerance, and the
        right value."""
        text = self.code.splitlines()[line - self.line]
        found, tolerance, right = CLAIM.fullmatch(text).groups()
        return literal_eval(found), literal_eval(tolerance or "0"), literal_eval(right)

    def claims(self) -> list[tuple[float, float, float]]:
        lines = self.code.splitlines()
        return [self.claim(self.line + i) for i, text in enumerate(lines) if "print(" in text]

    def judge(self, line: int, value: float) -> None:
        """Fails if the ``value`` printed at that line is not the one on the page."""
        found, tolerance, right = self.claim(line)
        if abs(value - found) <= tolerance:
            return
        section = f'the section "{self.title}" of docs/{PAGE.name}'
        if abs(value - right) <= tolerance:
            files = ", and the workaround in " + ", ".join(self.files) if self.files else ""
            pytest.fail(f"Mitsuba has fixed this: remove {section}{files} ({value})")
        pytest.fail(f"The fault has changed: {section} says {found}, and it is {value}")


def _read() -> tuple[str, list[Fault]]:
    """The code that runs before each block, and the faults."""
    page = PAGE.read_text(encoding="utf-8")
    preamble = BLOCK.search(page)
    faults = []
    for section in SECTION.finditer(page, preamble.end()):
        block = BLOCK.search(section["text"])
        if block:
            line = page.count("\n", 0, section.start("text") + block.start("code")) + 1
            files = list(dict.fromkeys(LINK.findall(section["text"])))
            faults.append(Fault(section["title"], line, block["code"], files, bool(block["mark"])))
    return preamble["code"], faults


PREAMBLE, FAULTS = _read()


@pytest.mark.parametrize(
    "fault",
    [
        pytest.param(f, id=f.title.replace(" ", "_"), marks=[pytest.mark.slow] * f.is_slow)
        for f in FAULTS
    ],
)
def test_mitsuba_still_has_this_fault(fault: Fault, tmp_path: Path, monkeypatch) -> None:
    def judge(value: float) -> None:
        fault.judge(sys._getframe(1).f_lineno, value)

    monkeypatch.chdir(tmp_path)
    namespace = {"print": judge}
    try:
        exec(PREAMBLE, namespace)
        # Line numbers are line numbers of the page, also in tracebacks
        exec(compile("\n" * (fault.line - 1) + fault.code, PAGE, "exec"), namespace)
    finally:
        # Objects that stay alive would be compiled into the kernels of other tests
        namespace.clear()
        gc.collect()
        mi.set_variant("llvm_ad_rgb")


def test_each_section_claims_something_wrong_and_links_to_files_that_exist() -> None:
    assert len({fault.title for fault in FAULTS}) == len(FAULTS) > 20
    for fault in FAULTS:
        assert fault.claims(), fault.title
        for found, tolerance, right in fault.claims():
            assert abs(found - right) > 2 * tolerance, fault.title
        for file in fault.files:
            assert (PAGE.parents[1] / file).is_file(), fault.title


def test_failures_distinguish_a_fixed_fault_from_a_changed_one() -> None:
    files = ["mitsuba_ext/transport/materials/glass.py"]
    fault = Fault("Dark glass", 7, "x = 1\nprint(x)  # 0.4 ± 0.01, not 0.5\n", files, False)
    fault.judge(8, 0.405)
    where = 'section "Dark glass".*mitsuba_ext/transport/materials/glass.py'
    with pytest.raises(pytest.fail.Exception, match=where):
        fault.judge(8, 0.499)
    with pytest.raises(pytest.fail.Exception, match="changed: .* says 0.4, and it is 0.3"):
        fault.judge(8, 0.3)
