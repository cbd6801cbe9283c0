"""Completion in the shell: ``eval "$(devrf -sc install=bash)"``.

Hydra completes keys, groups and their choices, of an installed command only. Here the values of
``stage`` and of other keys that have few come with them, and ``python -m devrf`` is completed too.
"""

from __future__ import annotations

import os
import sys
from collections.abc import Sequence

from hydra import initialize_config_dir
from hydra.core.global_hydra import GlobalHydra
from hydra.plugins.completion_plugin import DefaultCompletionPlugin

from devrf.cli.config import config_folder
from devrf.cli.config_check import ROOT
from devrf.cli.stages import known_stages
from devrf.cli.value_types import choices
from devrf.scenes.fetch import catalogue

# Without `=` among the shell's word breaks the whole of KEY=VALUE is one word. Other commands of
# Python are left to the shell's own completion of files.
INSTALL = """\
_devrf_complete() {{
    local line="$COMP_LINE" word="${{COMP_WORDS[COMP_CWORD]}}"
    COMPREPLY=()
    case "$line" in
        *python*" -m devrf "*) line="devrf ${{line#* -m devrf }}" ;;
        *python*) return ;;
    esac
    COMPREPLY=($(compgen -W "$(COMP_LINE="$line" '{python}' -m devrf -sc query=bash 2>/dev/null)" \\
        -- "$word"))
}}
COMP_WORDBREAKS=${{COMP_WORDBREAKS//=}}
complete -o nospace -o bashdefault -o default -F _devrf_complete devrf python python3
"""
UNINSTALL = "complete -r devrf python python3; unset -f _devrf_complete\n"


def answer_completion(arguments: Sequence[str]) -> bool:
    """Print what ``-sc install=bash``, ``uninstall`` and ``query`` ask for.

    Returns:
        Whether that was asked for; other shells are Hydra's.
    """
    if list(arguments[:1]) not in (["-sc"], ["--shell-completion"]):
        return False
    asked = arguments[1] if len(arguments) > 1 else ""
    if asked == "query=bash":
        print("\n".join(candidates(os.environ.get("COMP_LINE", ""))))
    elif asked == "install=bash":
        print(INSTALL.format(python=sys.executable), end="")
    elif asked == "uninstall=bash":
        print(UNINSTALL, end="")
    return asked.endswith("=bash")


def candidates(line: str) -> list[str]:
    """What the last word of ``devrf ARGUMENT …`` may become."""
    _, _, typed = line.partition(" ")
    key, is_set, _ = typed.split(" ")[-1].partition("=")
    if is_set and (values := _values(key, "stage=fetch" in typed.split())):
        return [f"{key}={value}" for value in values]
    with initialize_config_dir(str(config_folder()), version_base="1.3"):
        plugin = DefaultCompletionPlugin(GlobalHydra.instance().config_loader())
        return plugin._query(config_name="config", line=typed)


def _values(key: str, fetches: bool) -> list[str]:
    """The values that a key of the run takes, where they can be enumerated."""
    if key == "stage":
        return known_stages()
    if key == "scene":
        return [scene.name for scene in catalogue()] if fetches else []
    hint = ROOT.get(key)
    return ["true", "false"] if hint is bool else [str(value) for value in choices(hint)]
