"""Shell completion: scripts for the shells, and the answers to their requests.

It extends click's completion in two ways: candidates without a following space, and integrators
with ``:`` and ``=`` in bash, which splits words at these characters.
"""

from __future__ import annotations

import os
import shlex
from pathlib import Path

import click
from click.shell_completion import (
    BashComplete,
    CompletionItem,
    FishComplete,
    ShellComplete,
    ZshComplete,
    add_completion_class,
    split_arg_string,
)

#: The environment variable with which a shell requests candidates, named after the command.
VARIABLE = "_MITSUBA_EXT_COMPLETE"

_BASH = """\
%(complete_func)s() {
    local IFS=$'\\n' line
    local response=$(env COMP_LINE="${COMP_LINE:0:COMP_POINT}" COMP_WORDBREAKS="$COMP_WORDBREAKS" \\
        %(complete_var)s=bash_complete "$1")
    COMPREPLY=()
    for line in $response; do
        case "$line" in
            dir,*) compopt -o dirnames ;;
            file,*) compopt -o default ;;
            part,*) compopt -o nospace; COMPREPLY+=("${line#*,}") ;;
            plain,*) COMPREPLY+=("${line#*,}") ;;
        esac
    done
}
complete -o nosort -F %(complete_func)s %(prog_name)s
"""

_ZSH = """\
#compdef %(prog_name)s
%(complete_func)s() {
    local -a whole parts described
    local type value help
    for type value help in "${(@f)$(env COMP_WORDS="${words[1,CURRENT]}" \\
        COMP_CWORD=$((CURRENT-1)) %(complete_var)s=zsh_complete %(prog_name)s)}"; do
        case "$type" in
            dir) _path_files -/ ;;
            file) _path_files -f ;;
            part) parts+=("$value") ;;
            plain) [[ "$help" == _ ]] && whole+=("$value") || described+=("$value:$help") ;;
        esac
    done
    (( $#described )) && _describe -V unsorted described -U
    (( $#whole )) && compadd -U -V unsorted -a whole
    (( $#parts )) && compadd -U -S '' -V unsorted -a parts
    return 0
}
if [[ $zsh_eval_context[-1] == loadautofunc ]]; then
    %(complete_func)s "$@"
else
    compdef %(complete_func)s %(prog_name)s
fi
"""

_FISH = """\
function %(complete_func)s;
    set -l response (env %(complete_var)s=fish_complete COMP_WORDS=(commandline -cp) \\
        COMP_CWORD=(commandline -t) %(prog_name)s);
    for completion in $response;
        set -l metadata (string split -m 1 "," $completion);
        switch $metadata[1];
            case dir;
                __fish_complete_directories $metadata[2];
            case file;
                __fish_complete_path $metadata[2];
            case plain part;
                echo $metadata[2];
        end;
    end;
end;
complete --no-files --command %(prog_name)s --arguments "(%(complete_func)s)";
"""


class _Bash(BashComplete):
    source_template = _BASH

    def get_completion_args(self) -> tuple[list[str], str]:
        # COMP_WORDS is cut at ":" and "="
        line = os.environ["COMP_LINE"]
        *words, last = split_arg_string(line + "_")
        self._cut = _cut(line, last[:-1])
        return words[1:], last[:-1]

    def format_completion(self, item: CompletionItem) -> str:
        return f"{item.type},{item.value.removeprefix(self._cut)}"


def _cut(line: str, incomplete: str) -> str:
    """The part of the last word that bash treats as a separate word."""
    try:
        shlex.split(line)
    except ValueError:  # bash does not split words within quotes
        return ""
    ends = [letter for letter in ":=" if letter in os.environ.get("COMP_WORDBREAKS", ":=")]
    return incomplete[: 1 + max((incomplete.rfind(letter) for letter in ends), default=-1)]


class _Zsh(ZshComplete):
    source_template = _ZSH


class _Fish(FishComplete):
    source_template = _FISH


_SHELLS: dict[str, type[ShellComplete]] = {"bash": _Bash, "zsh": _Zsh, "fish": _Fish}


def register() -> None:
    """Makes click use the completion classes of this module."""
    for name, shell in _SHELLS.items():
        add_completion_class(shell, name)


@click.command(short_help="Print a script that lets the shell complete commands.")
@click.argument("shell", required=False, type=click.Choice(sorted(_SHELLS)))
@click.pass_context
def completion(context: click.Context, shell: str | None) -> int:
    """Print a script for SHELL (by default, the one that $SHELL names), which completes
    sub-commands, options, plugins with their parameters, and files.

    In ~/.bashrc or ~/.zshrc: eval "$(mitsuba-ext completion bash)". In
    ~/.config/fish/config.fish: mitsuba-ext completion fish | source.
    """
    name = shell or Path(os.environ.get("SHELL", "")).name
    if name not in _SHELLS:
        raise click.UsageError(f"name a shell: {', '.join(sorted(_SHELLS))}")
    cli = context.find_root().command
    click.echo(_SHELLS[name](cli, {}, "mitsuba-ext", VARIABLE).source())
    return 0

