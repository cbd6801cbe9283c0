"""The command: what is typed is completed and composed, the config checked, the stage run."""

from __future__ import annotations

import os
import sys
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path

import hydra
from hydra import compose, initialize_config_dir
from hydra.core.global_hydra import GlobalHydra
from hydra.core.hydra_config import HydraConfig
from hydra.errors import HydraException
from hydra.plugins.completion_plugin import DefaultCompletionPlugin
from omegaconf import DictConfig

import devrf
from devrf.apps.fetch import catalogue
from devrf.cli.complete import completed, quoted_path
from devrf.cli.config import config_folder, in_sweep, known_stages, register_config
from devrf.cli.config_check import ROOT, check_config, check_extras, choices_at, choices_of
from devrf.cli.messages import report_user_errors
from devrf.cli.restore_config import log_told
from devrf.cli.run_folder import working_in
from devrf.cli.sweep import naming_failures, record_failure
from devrf.errors import DevrfError
from devrf.system.process import (
    Interrupted,
    end_at_once,
    handle_signals,
    importing,
    quiet_if_unread,
    tune_for_cpu,
    use_utf8,
)

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

register_config()


@quiet_if_unread()
def entry() -> None:
    """Run the application.

    A mistake in the input ends it with one line and status 2, a sweep of which jobs failed with
    their names and status 3, a signal with one line and 128 plus its number: 130 for Ctrl-C,
    143 for SIGTERM, 141 for output that nobody reads.
    """
    use_utf8()
    # Hydra would print a traceback of its own and exit with 1 if it were not told to raise.
    os.environ["HYDRA_FULL_ERROR"] = "1"
    if (answer := _answer_at_once(sys.argv[1:])) is not None:
        print(answer)
        return
    tune_for_cpu()
    try:
        with handle_signals(end_at_once), report_user_errors(), naming_failures():
            sys.argv[1:] = completed(sys.argv[1:])
            main()
    # A KeyboardInterrupt is raised by another library's handler of Ctrl-C.
    except (Interrupted, KeyboardInterrupt) as stop:
        print(f"devrf: {getattr(stop, 'message', 'interrupted')}", file=sys.stderr)
        sys.exit(getattr(stop, "code", 130))


def run(config: DictConfig) -> float | None:
    """Run ``stage=…`` in Hydra's output folder; return the objective, if measured."""
    folder = Path(HydraConfig.get().runtime.output_dir)
    guard = record_failure(config, folder) if in_sweep() else report_user_errors()
    with guard, working_in(folder, config):
        log_told()
        check_config(config)
        check_extras(config)
        # Imported here: --help and a misspelt key are answered before torch has loaded.
        with importing():
            from devrf.cli.run import run_stage

        return run_stage(config, folder)
    return None  # of a job that failed


# A name of its own: other processes import `run` by its name.
main = hydra.main(config_path=str(config_folder()), config_name="config", version_base="1.3")(run)


def _answer_at_once(words: Sequence[str]) -> str | None:
    """The answer to ``--version``, and to bash; what other shells ask is Hydra's to answer."""
    match words:
        case [*_, "--version"]:
            return f"devrf {devrf.__version__}"
        case ["-sc" | "--shell-completion", "install=bash"]:
            return INSTALL.format(python=sys.executable)
        case ["-sc" | "--shell-completion", "query=bash"]:
            return "\n".join(candidates(os.environ.get("COMP_LINE", "")))
    return None


def candidates(line: str) -> list[str]:
    """What the last word of ``devrf ARGUMENT …`` may become.

    Hydra knows keys, groups and their choices; the values of other keys are those that parts
    declare. What only a scene from disk has is known before its folder is typed, too.
    """
    *typed, word = line.split(" ")[1:]
    before = [quoted_path(earlier, multirun=False) for earlier in typed]
    key, is_set, _ = word.partition("=")
    values: Sequence[object] = known_stages() if key == "stage" else choices_of(ROOT.get(key))
    if key == "scene" and "stage=fetch" in before:
        values = [scene.name for scene in catalogue()]
    found: list[str] = []
    with initialize_config_dir(str(config_folder()), version_base="1.3"):
        plugin = DefaultCompletionPlugin(GlobalHydra.instance().config_loader())
        for given in (before, ["data=inward", *before]):
            with suppress(HydraException, DevrfError):
                values = values or (is_set and choices_at(compose("config", given), key)) or ()
            found = found or [f"{key}={value}" for value in values if is_set]
            found = found or plugin._query("config", " ".join([*given, word]))
    return [candidate for candidate in found if "_target_" not in candidate]
