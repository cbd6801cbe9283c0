"""A composed config against the signatures of its ``_target_``, before anything is built."""

from __future__ import annotations

import inspect
import json
import logging
import re
import types
from collections.abc import Iterable, Mapping
from dataclasses import is_dataclass
from importlib.util import find_spec
from pathlib import Path
from typing import Annotated, Any, Literal, Union, cast, get_args, get_origin, get_type_hints

from annotated_types import Ge, Lt
from hydra.utils import get_object
from omegaconf import DictConfig, OmegaConf
from typing_extensions import TypedDict

from devrf.cli.config import config_folder
from devrf.errors import DevrfError, did_you_mean

# Keys outside the parts.
ROOT: dict[str, Any] = {
    "stage": str,
    "method": str,
    "seed": Annotated[int, Ge(0), Lt(2**32)],
    "resume": bool,
    "memory_check": bool,
    "priors": Literal["all", "none"],
    "ckpt": str | Path | None,
    "objective": str,
    "scene": str | None,
    "decoder_precision": Literal["auto", "float32", "bfloat16"],
}
# What cannot be loaded ends the command with one line; Hydra would log it before.
logging.getLogger("hydra.utils").setLevel(logging.CRITICAL)
# Hydra's own keys in a part's config.
RESERVED = {"_target_", "_partial_", "_convert_", "_recursive_", "_args_"}
# What pydantic calls a key that does not exist; and what is left to the part itself: a type that
# no config value has, and what a row of settings lacks.
UNKNOWN = ("extra_forbidden", "unexpected_keyword_argument")
LEFT = ("needs_python_object", "is_instance_of", "missing", "missing_argument")
REFERENCE = re.compile(r"\$\{([\w.]+)\}")

Node = Mapping[Any, Any]


def check_config(config: DictConfig) -> None:
    """Check that every value is set, belongs to a part, and has the type that the part expects.

    Raises:
        DevrfError: naming the key at fault and what was expected.
    """
    for key in sorted(OmegaConf.missing_keys(config)):
        value = "PATH" if key.endswith("root") else "VALUE"
        raise DevrfError(f"{key}: required; give {key}={value}")
    raw: Any = OmegaConf.to_container(config)
    resolved: Any = OmegaConf.to_container(config, resolve=True)
    _check_values(ROOT, {key: resolved.get(key) for key in ROOT}, {}, "")
    # A value outside any part counts as read when some part refers to it: ${loss.search}.
    _check_node(raw, resolved, "", {*ROOT, *REFERENCE.findall(OmegaConf.to_yaml(config))})


def _check_node(raw: Node, resolved: Node, path: str, read: set[str]) -> None:
    """Check a part by its signature; of another node the parts below, and that values are read."""
    keys = [str(key) for key in raw if key not in RESERVED]
    is_part = "_target_" in raw
    for key in keys:
        where, value = f"{path}{key}", resolved[key]
        if isinstance(raw[key], Mapping) and (not is_part or "_target_" in raw[key]):
            _check_node(raw[key], value, f"{where}.", read)
        elif not is_part and value is not None:
            if not any(f"{where}.".startswith(f"{ref}.") for ref in read):
                below = (ref.removeprefix(path) for ref in read if ref.startswith(path))
                known = {*keys, *(name.split(".")[0] for name in below)}
                raise unknown_key(where, known - {key})
    if is_part:
        # The key to name is the one where the user sets the value.
        texts = {key: raw[key] for key in keys if isinstance(raw[key], str)}
        set_at = {key: at[1] for key, text in texts.items() if (at := REFERENCE.fullmatch(text))}
        _check_values(_settings(resolved, path), {key: resolved[key] for key in keys}, set_at, path)


def _settings(part: Node, path: str) -> dict[str, Any]:
    """The type of each key of a part, by name; ``**`` if it takes any name."""
    settings = _parameters(str(part["_target_"]), path)
    for below in part.values():
        if "**" in settings and isinstance(below, Mapping) and below.get("_partial_"):
            # It is made later, of the keys beside it.
            settings = {**_parameters(str(below["_target_"]), path), **settings}
            del settings["**"]
    return settings


def _parameters(target: str, path: str) -> dict[str, Any]:
    try:
        part = get_object(target)
        parameters = inspect.signature(part).parameters.values()
    except Exception as error:
        raise DevrfError(f"{path}_target_: cannot load {target!r} ({error})") from None
    try:
        # A dataclass may inherit fields whose types only its base's module knows.
        own_init = inspect.isclass(part) and not is_dataclass(part)
        hints = get_type_hints(part.__init__ if own_init else part)
    except (NameError, TypeError):  # names imported only for a type checker
        hints = {}
    # Whatever the type, a part takes what it has by itself.
    types = {p.name: hints.get(p.name, Any) for p in parameters}
    types |= {p.name: types[p.name] | None for p in parameters if p.default is None}
    return {"**" if p.kind is p.VAR_KEYWORD else p.name: types[p.name] for p in parameters}


def _check_values(hints: Node, values: Node, set_at: Mapping[str, str], path: str) -> None:
    """Check values by the types of their keys, as JSON: a list is any sequence, text is a path.

    Args:
        hints: a type by key; ``**`` if there may be others.
        values: by key; parts among them are checked apart.
        set_at: the keys that are named in their place.
        path: where they are: ``schedule.``, or empty.

    Raises:
        DevrfError: a value does not fit, or there is no such key.
    """
    # Imported here: --help is answered before it has loaded.
    from pydantic import ConfigDict, TypeAdapter, ValidationError

    parts = {
        key for key, value in values.items() if isinstance(value, Mapping) and "_target_" in value
    }
    fields = {key: hint for key, hint in hints.items() if key != "**"}
    settings = cast(Any, TypedDict)("settings", fields, total=False)
    settings.__pydantic_config__ = ConfigDict(extra="forbid", arbitrary_types_allowed=True)
    known = {key: value for key, value in values.items() if "**" not in hints or key in fields}
    plain = {key: None if key in parts else value for key, value in known.items()}
    try:
        TypeAdapter(settings).validate_json(json.dumps(plain, default=str), strict=True)
    except ValidationError as error:
        issues = sorted(error.errors(), key=lambda issue: issue["type"] not in UNKNOWN)
        for issue in issues:
            key, *below = map(str, issue["loc"])
            if issue["type"] in LEFT or (key in parts and issue["type"] not in UNKNOWN):
                continue
            where, value, hint = set_at.get(key, f"{path}{key}"), plain[key], hints.get(key)
            for name in below:
                if isinstance(value, Mapping) and name in value:
                    where, value = f"{where}.{name}", value[name]
            if issue["type"] in UNKNOWN:
                within = [hint]  # and all types that it is made of
                for kind in within:
                    within.extend(get_args(kind))
                rows = (get_type_hints(kind) for kind in within if is_dataclass(kind))
                raise unknown_key(where, next(rows, hints)) from None
            alike = (other for other in issues if str(other["loc"][0]) == key)
            wanted = (other["msg"].removeprefix("Input should be ") for other in alike)
            expected = " or ".join(dict.fromkeys(wanted))
            meant = did_you_mean(value, choices_of(hint), f"{where}=")
            raise DevrfError(f"{where}: expected {expected}, not {value!r}{meant}") from None


def unknown_key(where: str, known: Iterable[object]) -> DevrfError:
    """The error for a key that does not exist, with the closest one that does."""
    name = where.rpartition(".")[2]
    meant = did_you_mean(name, (k for k in known if k != "**"), where[: -len(name)])
    group = where.removesuffix(f".{name}")
    files = sorted((config_folder() / group).glob("*.yaml"))
    # As a list: a DictConfig does not "contain" what is required and not given.
    having = ", ".join(path.stem for path in files if name in list(OmegaConf.load(path)))
    instead = f"it belongs to {group}={having}" if having else "--cfg job shows every key there is"
    return DevrfError(f"{where}: no such key{meant or f'; {instead}'}")


def choices_of(hint: Any) -> tuple[object, ...]:
    """The values that a hint enumerates, as they are typed; none where it does not."""
    inner = get_args(hint)
    if get_origin(hint) is Literal:
        return inner
    if hint is bool:
        return "true", "false"
    if get_origin(hint) in (Union, types.UnionType):
        return tuple(value for argument in inner for value in choices_of(argument))
    return ()


def choices_at(config: DictConfig, key: str) -> tuple[object, ...]:
    """The values that the part with ``key`` in a composed config enumerates for it."""
    parent, _, name = key.rpartition(".")
    part = OmegaConf.select(config, parent)
    if not isinstance(part, DictConfig) or "_target_" not in part:
        return ()
    node: Any = OmegaConf.to_container(part)
    return choices_of(_settings(node, f"{parent}.").get(name))


def check_extras(config: DictConfig) -> None:
    """Refuse by a DevrfError settings for which an extra of devrf is not installed."""
    tensorboard = "TensorBoard" in config.logger.get("_target_", "")
    exports, meshes = config.stage == "export", "skimage trimesh fast_simplification"
    usd = exports and config.export.format == "usd"
    for chosen, setting, packages, extra, instead in (
        (tensorboard, "logger=tensorboard", "tensorboard", "tensorboard", "logger=csv"),
        (config.stage == "view", "stage=view", "viser", "viewer", "stage=render"),
        (config.viewer.get("training"), "viewer=true", "viser", "viewer", "viewer=false"),
        (exports, "stage=export", meshes, "export", "stage=render"),
        (usd, "export.format=usd", "pxr", "export", "export.format=gltf"),
    ):
        for package in packages.split():
            if chosen and find_spec(package) is None:
                raise DevrfError(
                    f"{setting}: {package} is not installed; run pip install "
                    f'"devrf[{extra}]", or set {instead}'
                )
