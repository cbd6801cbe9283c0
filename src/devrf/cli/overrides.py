"""Lists of overrides: those of a command line, and what a checkpoint keeps of them."""

from __future__ import annotations

import re
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.override_parser.types import Override

# Overrides that say what to do with a run, on which machine, and what to log, not what the run is.
OF_A_COMMAND = {"stage", "ckpt", "resume", "memory_check", "objective", "hparams_search"}
OF_A_COMMAND |= {"hydra", "report", "still", "export", "trainer", "logger", "callbacks", "kernels"}
OF_A_COMMAND |= {"viewer"}
# Names code to be run, which a checkpoint, perhaps a stranger's, may not choose.
CODE = "_target_"
# Values that are relative to the folder in which they were typed.
PATHS = {"data.root", "evaluation.lpips_weights"}


@dataclass(frozen=True)
class Overrides:
    """Overrides in their order, parsed.

    Attributes:
        parsed: each by Hydra's grammar.
    """

    parsed: tuple[Override, ...]

    @classmethod
    def of(cls, texts: Iterable[str]) -> Overrides:
        """The overrides ``texts``.

        Raises:
            HydraException: one is not understood.
        """
        return cls(tuple(OverridesParser.create().parse_overrides(list(texts))))

    @property
    def texts(self) -> list[str]:
        """Each as it was written."""
        return [text_of(one) for one in self.parsed]

    @property
    def sweeps(self) -> bool:
        """Whether one of them gives several values."""
        return any(one.is_sweep_override() for one in self.parsed)

    def values(self, key: str) -> list[str]:
        """The value of ``key``, of a sweep all of them; none where there is none."""
        for one in reversed(self.parsed):
            if one.key_or_group == key and not one.is_delete():
                if one.is_choice_sweep():
                    return [str(getattr(v, "text", v)) for v in one.sweep_iterator()]
                return [] if one.value() is None else [str(one.value())]
        return []

    def value(self, key: str) -> str | None:
        """The value of ``key``; None where there is none, or several."""
        values = self.values(key)
        return values[0] if len(values) == 1 else None


def recorded(overrides: Iterable[str]) -> list[str]:
    """What a checkpoint keeps of a command's overrides; paths of files are made absolute.

    What it keeps of these again is the same.

    Raises:
        HydraException: an override is not understood.
    """
    kept = []
    for one in Overrides.of(overrides).parsed:
        key, value = one.key_or_group, None if one.is_delete() else one.value()
        if root_of(one) in OF_A_COMMAND or CODE in text_of(one):
            continue
        if key in PATHS and isinstance(value, str) and "${" not in value:
            kept.append(f"{key}={quoted(str(Path(value).expanduser().absolute()))}")
        else:
            kept.append(text_of(one))
    return kept


def quoted(text: str) -> str:
    """A value as Hydra's grammar takes it literally, in quotes where it needs them."""
    return text if re.fullmatch(r"[A-Za-z0-9_./-]+", text) else in_quotes(text)


def in_quotes(text: str) -> str:
    """``text`` as Hydra's grammar takes it for text, whatever it holds."""
    mark = "'" if '"' in text and "'" not in text else '"'
    # Backslashes count as escapes only before a quotation mark and at the end.
    escaped = re.sub(rf"(\\*)({mark}|$)", lambda m: m[1] * 2 + (m[2] and f"\\{mark}"), text)
    return f"{mark}{escaped}{mark}"


def text_of(override: Override) -> str:
    """An override as it was written."""
    return str(override.input_line)


def root_of(override: Override) -> str:
    """The first part of an override's key: ``data`` of ``data.root``."""
    return re.split("[./]", override.key_or_group)[0]
