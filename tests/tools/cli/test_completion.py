"""Completion in shells: the offered words, and their use by bash, zsh and fish."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from mitsuba_ext import cli
from mitsuba_ext.cli import candidates
from mitsuba_ext.cli.completion import VARIABLE


@pytest.fixture
def offered(monkeypatch, capsys):
    """What bash is offered for a line."""

    def ask(line: str) -> list[str]:
        monkeypatch.setenv(VARIABLE, "bash_complete")
        monkeypatch.setenv("COMP_LINE", line)
        monkeypatch.setenv("COMP_WORDBREAKS", " :=")
        with pytest.raises(SystemExit):
            cli.main([])
        return capsys.readouterr().out.split()

    return ask


def test_completion_offers_options_plugins_and_files(offered, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for name in ("box.xml", "box.png", "animate.py", ".hidden.xml"):
        Path(name).touch()
    Path("boxes").mkdir()
    for line, expected in {
        "mitsuba-ext me": ["plain,merge"],
        "mitsuba-ext render --check": ["plain,--checkpoint"],
        "mitsuba-ext render ": ["plain,box.xml", "part,boxes/"],
        "mitsuba-ext render x.xml --checkpoint ": ["part,boxes/"],
        "mitsuba-ext render --plugin ": ["plain,animate.py", "part,boxes/"],
        "mitsuba-ext render -o ": ["file,"],
        "mitsuba-ext render --integrator nee": ["part,neepp"],
        "mitsuba-ext render --integrator=nee": ["part,neepp"],
        "mitsuba-ext render --integrator b": ["plain,box.xml", "part,boxes/", "part,bdpt"],
        # bash has cut the word at ":" and "="
        "mitsuba-ext render --integrator neepp:gr": ["part,grid="],
        "mitsuba-ext render --integrator neepp:grid=8,max_d": ["part,8,max_depth="],
        "mitsuba-ext render --integrator neepp:grid=8,gr": [],
        "mitsuba-ext render --integrator neepp:hide_emitters=t": ["part,true"],
        "mitsuba-ext compare box.xml volpathm": ["part,volpathmis"],
        "mitsuba-ext compare box.xml path:max": ["part,max_depth="],
        'mitsuba-ext compare box.xml "variance:nested=[neep': ["part,variance:nested=[neepp"],
        "mitsuba-ext render --integrator variance:nested=[neepp:gri": ["part,grid="],
        "mitsuba-ext list sobol": ["plain,sobol_owen"],
        "mitsuba-ext render no/such/folder/": [],
        "mitsuba-ext completion z": ["plain,zsh"],
    }.items():
        assert offered(line) == expected, line
    assert "plain,llvm_ad_rgb" in offered("mitsuba-ext render --variant ll")
    assert "plain,visibility_roulette" in offered("mitsuba-ext list ")


def test_nested_plugins_are_offered_in_brackets_only():
    def names(text: str) -> list[str]:
        return [value for value, _kind in candidates._specifications(text)]

    assert names("spatial") == []
    head = "composed_path:next_event=["
    assert names(f"{head}spatial") == [f"{head}spatial_lights"]
    done = f"{head}spatial_lights:a=1,b=[path]],"
    assert f"{done}max_depth=" in names(done) and f"{done}next_event=" not in names(done)


def test_an_answer_needs_no_mitsuba(tmp_path):
    code = """
import sys
from mitsuba_ext import cli
try:
    cli.main()
finally:
    print(sorted({"mitsuba", "drjit", "numpy", "rich"} & set(sys.modules)))
"""
    environment = {VARIABLE: "bash_complete", "COMP_LINE": "mitsuba-ext render --integrator neepp:"}
    result = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True,
        env={**os.environ, **environment},
    )  # fmt: skip
    assert result.stdout.splitlines()[-1] == "[]" and "part,max_depth=" in result.stdout


def test_unknown_shells_are_named(run, monkeypatch):
    monkeypatch.setenv("SHELL", "/bin/tcsh")
    code, _, err = run("completion")
    assert code == 2 and "name a shell: bash, fish, zsh" in err
    monkeypatch.setenv("SHELL", "/bin/zsh")
    assert "compdef" in run("completion")[1]


@pytest.fixture
def command(tmp_path) -> Path:
    file = tmp_path / "mitsuba-ext"
    file.write_text(f'#!/bin/sh\nexec {sys.executable} -m mitsuba_ext "$@"\n')
    file.chmod(0o755)
    return file


def test_bash_gets_words_as_it_cuts_them(command, tmp_path):
    if not shutil.which("bash"):
        pytest.skip("no bash")
    script = f"""
compopt() {{ echo "compopt $1 $2"; }}
eval "$({command} completion bash)"
COMP_LINE="mitsuba-ext render --integrator neepp:rej" COMP_POINT=41
_mitsuba_ext_completion {command}
echo "${{COMPREPLY[@]}}"
complete -p mitsuba-ext
"""
    result = subprocess.run(["bash", "-c", script], capture_output=True, text=True)
    assert result.stdout.splitlines()[:2] == ["compopt -o nospace", "rejection="], result.stderr
    assert "-F _mitsuba_ext_completion mitsuba-ext" in result.stdout


@pytest.mark.parametrize("shell", ["zsh", "fish"])
def test_zsh_and_fish_can_read_their_scripts(command, shell):
    if not shutil.which(shell):
        pytest.skip(f"no {shell}")
    script = {
        "zsh": f'autoload -U compinit; compinit -D; eval "$({command} completion zsh)"; '
               'echo $_comps[mitsuba-ext]',
        "fish": f"set PATH {command.parent} $PATH; mitsuba-ext completion fish | source; "
                'complete -C "mitsuba-ext render --integrator neepp:rej"',
    }[shell]  # fmt: skip
    flag = {"zsh": "-f", "fish": "--no-config"}[shell]
    result = subprocess.run([shell, flag, "-c", script], capture_output=True, text=True)
    expected = {"zsh": "_mitsuba_ext_completion", "fish": "neepp:rejection="}[shell]
    assert result.stdout.split() == [expected], result.stderr
