"""A composed config against the signatures of its ``_target_``, before anything is built.

Each part, a section with ``_target_``, is checked for itself: the keys that its class or function
takes, by name and type. The types are those by which settings check themselves when they are built
from Python (:mod:`devrf.system.options`), so that each is written once. A key outside the parts
belongs to the root (``ROOT``), is read by a part (``${loss.search}``), or is one of an option of a
group: typing over a part's ``${...}`` leaves one unread.
"""

from __future__ import annotations

import inspect
import json
import logging
import re
from collections.abc import Iterable, Iterator, Mapping
from contextlib import suppress
from dataclasses import is_dataclass
from functools import cache, reduce
from operator import getitem
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal, cast, get_type_hints

import yaml
from annotated_types import Ge, Lt
from hydra.core.override_parser.types import Override
from hydra.utils import get_object
from omegaconf import DictConfig, OmegaConf
from typing_extensions import TypedDict

from devrf.cli.config import REFERENCE, config_folder, in_sweep, overrides, set_at
from devrf.errors import DevrfError, did_you_mean

if TYPE_CHECKING:
    from pydantic import TypeAdapter

log = logging.getLogger(__name__)

# Keys of the root.
ROOT: dict[str, Any] = {
    "stage": str,
    "method": str,
    "facing": Literal["inward", "forward"],
    "seed": Annotated[int, Ge(0), Lt(2**32)],
    "deterministic": bool | Literal["warn"],
    "rehearse": bool,
    "output_dir": str | Path,
    "resume": bool,
    "memory_check": bool,
    "priors": Literal["all", "none"],
    "ckpt": str | Path | None,
    "objective": str,
    "scene": str | None,
    "outputs": str | Path,
    "kernels": Literal["auto", "torch"],
}
# What no configuration can be without.
NEEDED = {*ROOT, "data", "evaluation", "trainer", "protocol", "experiment", "ablation"}
NEEDED |= {"schedule", "field", "sampling", "loss", "video", "still", "export", "viewer", "report"}
# Groups whose files have no section of the group's name: they change those of other groups.
CHANGES = {"ablation", "comparison", "experiment", "facing", "for_scene", "hparams_search"}
CHANGES |= {"profile"}
# A part that cannot be loaded ends the command with one line; Hydra would log it before.
logging.getLogger("hydra.utils").setLevel(logging.CRITICAL)
# Hydra's own keys in a part's config.
RESERVED = {"_target_", "_partial_", "_convert_", "_recursive_", "_args_"}
# Pydantic's names of a key that does not exist, of a value whose class no config value has, and of
# a key that a row of settings lacks, which is left to the part itself.
UNKNOWN = ("extra_forbidden", "unexpected_keyword_argument")
BUILT = ("needs_python_object", "is_instance_of")
LEFT = ("missing", "missing_argument")
# LibYAML takes a tenth of the time; not every build of PyYAML has it.
LOADER = getattr(yaml, "CSafeLoader", yaml.SafeLoader)

Node = Mapping[Any, Any]
Names = tuple[Any, ...]


def check_config(config: DictConfig) -> None:
    """Check that every value is set, belongs to a part, and has the type that the part expects.

    They are checked as JSON: a list is any sequence, text is a path.

    Raises:
        DevrfError: naming the key at fault and what was expected.
    """
    # Imported here: --help is answered before it has loaded.
    from devrf.system.options import expectation

    raw: Any = OmegaConf.to_container(config)
    for key in sorted(OmegaConf.missing_keys(config)):
        value = "PATH" if key.endswith("root") else "VALUE"
        raise DevrfError(f"{key}: required; give {key}={value}")
    resolved: Any = OmegaConf.to_container(config, resolve=True)
    # A key that is missing is wrong in its type, too.
    issues = _issues(dict.fromkeys(ROOT) | resolved, ROOT | {"**": Any}, ())
    read = tuple(f"{key}." for key in REFERENCE.findall(json.dumps(raw, default=str)))
    # Keys of other methods, which a sweep over several may add to each.
    added = tuple(
        f"{word.partition('=')[0].lstrip('+')}." for word in overrides() if word[0] == "+"
    )
    for names, value in _walk(raw):
        key = ".".join(names)
        if _is_part(value):
            part = reduce(getitem, names, resolved)
            issues += _issues(part, _settings(part, key), names)
        elif key in ROOT or f"{key}.".startswith(read):
            continue
        elif f"{key}._target_" in _of_options() and value is not False:
            said = "Input should be a section with _target_, or null"
            issues.append((names, {"type": "section", "msg": said, "input": value}))
        elif key not in _of_options():
            issues.append((names, {"type": UNKNOWN[0]}))
        elif not in_sweep() and f"{key}.".startswith(added):
            log.warning("%s: nothing reads it here; it belongs to %s", key, _of_options()[key])
    for names, issue in issues:
        if issue["type"] in UNKNOWN:
            lacking = [other[-1] for other, issue in issues if issue["type"] in LEFT]
            raise unknown_key(config, names, lacking)
    wrong: dict[str, list[Any]] = {}
    for names, issue in issues:
        # Whether it is right, only building the part tells: a row's keys, a part's class.
        if issue["type"] not in LEFT and not (issue["type"] in BUILT and _is_part(issue["input"])):
            wrong.setdefault(set_at(config, names) or names[0], []).append(issue)
    for where, (issue, *others) in wrong.items():
        value = issue["input"]
        plain = [each["msg"] for each in (issue, *others) if each["type"] not in BUILT]
        said = expectation(plain or [issue["msg"]], repr(value))
        choices = re.findall("'([^']+)'", said.rpartition(", not ")[0])
        if issue["type"] in BUILT:
            said = f"expected a section with _target_, not {value!r}"
        raise DevrfError(f"{where}: {said}{did_you_mean(value, choices, f'{where}=')}")


def sets_only(typed: Iterable[Override], section: str, *keys: str) -> bool:
    """Whether a command sets nothing but the ``section`` and these ``keys``."""
    names = (override.key_or_group for override in typed)
    return all(name in keys or name.startswith(f"{section}.") for name in names)


def check_section(config: DictConfig, section: str) -> None:
    """As :func:`check_config`, of one section and the root's keys; the other parts are not loaded.

    The section's references are resolved, those to other sections, too.
    """
    OmegaConf.resolve(config[section])
    check_config(OmegaConf.masked_copy(config, [*ROOT, section]))


def _issues(values: Node, types: Mapping[str, Any], names: Names) -> list[tuple[Names, Any]]:
    """Pydantic's errors of the section at ``names``, each with the names that lead to it."""
    from pydantic import ValidationError

    hints = {key: hint for key, hint in types.items() if key != "**"}
    for key, value in values.items():
        # A part is checked in its own place.
        if _is_part(value) or (key not in types and "**" in types):
            hints[key] = Any
    keys = tuple(hints.items())
    try:
        section = _section(keys)
    except TypeError:  # a type that has no hash, of a part that is a user's
        section = _section.__wrapped__(keys)
    try:
        section.validate_json(json.dumps(values, default=str), strict=True)
    except ValidationError as error:
        return [(names + issue["loc"], issue) for issue in error.errors()]
    return []


@cache
def _section(hints: tuple[tuple[str, Any], ...]) -> TypeAdapter[Any]:
    """What checks a section with these keys and types; the jobs of a sweep share it."""
    from pydantic import TypeAdapter

    kind = cast(Any, TypedDict)("Section", dict(hints), total=False)
    kind.__pydantic_config__ = {"extra": "forbid", "arbitrary_types_allowed": True}
    return TypeAdapter(kind)


def _walk(node: Node, names: Names = (), inside: bool = False) -> Iterator[tuple[Names, Any]]:
    """The parts, and the values that no part holds, each with the names that lead to it."""
    if _is_part(node):
        inside = True
        yield names, node
    for key, value in node.items():
        if isinstance(value, Mapping):
            yield from _walk(value, (*names, key), inside)
        elif value is not None and not inside:
            yield (*names, key), value


def _settings(part: Node, path: str) -> dict[str, Any]:
    """The type of each key of a part, by name; ``**`` if it takes any name."""
    settings = _parameters(str(part["_target_"]), path)
    for below in part.values():
        if "**" in settings and isinstance(below, Mapping) and below.get("_partial_"):
            # It is made later, of the keys beside it.
            del settings["**"]
            settings = {**_parameters(str(below["_target_"]), path), **settings}
    return settings | dict.fromkeys(RESERVED, Any)


def _parameters(target: str, path: str) -> dict[str, Any]:
    try:
        part = get_object(target)
        parameters = inspect.signature(part).parameters.values()
    except Exception as error:
        raise DevrfError(f"{path}._target_: cannot load {target!r} ({error})") from None
    # A dataclass may inherit fields whose types only its base's module knows.
    own_init = inspect.isclass(part) and not is_dataclass(part)
    hints: dict[str, Any] = {}
    with suppress(NameError, TypeError):  # names imported only for a type checker
        hints = get_type_hints(part.__init__ if own_init else part, include_extras=True)
    types = {
        "**" if p.kind is p.VAR_KEYWORD else p.name: hints.get(p.name, Any) for p in parameters
    }
    # A part takes its own default, whatever the type.
    return types | {p.name: types[p.name] | None for p in parameters if p.default is None}


def _is_part(value: object) -> bool:
    return isinstance(value, Mapping) and "_target_" in value


def unknown_key(config: DictConfig, names: Names, others: Iterable[object] = ()) -> DevrfError:
    """The error for a key that does not exist, with the closest one that does.

    Args:
        config: the config, or one in which the key is missing.
        names: those that lead to the key.
        others: names that its section might have, beside those that it has.
    """
    section, name = set_at(config, names[:-1]), str(names[-1])
    where = f"{section}.{name}".lstrip(".")
    there = OmegaConf.select(config, section) if section else config
    known = {*there, *others} - {name} if isinstance(there, DictConfig) else others
    group, *path = where.split(".")
    if path and group in {"method", *CHANGES}:
        header = f"a file of {group}=NAME begins with the line '# @package _global_'"
        return DevrfError(f"{where}: no part reads it; {header}")
    deeper = [k for k in _of_options() if k.startswith(f"{group}.") and k.split(".")[2:] == path]
    meant = did_you_mean(name, sorted(map(str, known)), where[: -len(name)])
    if not meant and where in _of_options():
        meant = f"; it belongs to {_of_options()[where]}"
    elif not meant and path and deeper:
        meant = f"; it is {' or '.join(deeper)}"
    if not meant:
        return DevrfError(f"{where}: no part reads it; leave it out (--cfg job shows every key)")
    return DevrfError(f"{where}: no such key{meant}")


@cache
def _of_options() -> Mapping[str, str]:
    """The keys that options of groups set, and these options: ``data=inward, forward``."""
    keys: dict[str, str] = {}
    for file in sorted(config_folder().glob("*/*.yaml")):
        group = file.parent.name
        if group in CHANGES:
            continue
        # The files of a method and of a schedule have sections of their own.
        above = () if group in ("method", "schedule") else (group,)
        nodes: list[tuple[Names, Any]] = [(above, yaml.load(file.read_bytes(), LOADER))]
        for names, node in nodes:
            key = ".".join(names)
            keys[key] = f"{keys[key]}, {file.stem}" if key in keys else f"{group}={file.stem}"
            if isinstance(node, Mapping):
                nodes += [((*names, str(name)), below) for name, below in node.items()]
    return keys
