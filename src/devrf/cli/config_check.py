"""A composed config against the signatures of its ``_target_``, before anything is built."""

from __future__ import annotations

import inspect
import json
import logging
import re
from collections.abc import Iterable, Iterator, Mapping
from contextlib import suppress
from dataclasses import is_dataclass
from functools import reduce
from importlib.util import find_spec
from operator import getitem
from pathlib import Path
from typing import Annotated, Any, Literal, cast, get_type_hints

from annotated_types import Ge, Lt
from hydra.utils import get_object
from omegaconf import MISSING, DictConfig, OmegaConf
from typing_extensions import TypedDict

from devrf.cli.config import config_folder
from devrf.errors import DevrfError, did_you_mean

# Keys outside the parts.
ROOT: dict[str, Any] = {
    "stage": str,
    "method": str,
    "facing": Literal["inward", "forward"],
    "seed": Annotated[int, Ge(0), Lt(2**32)],
    "rehearse": bool,
    "resume": bool,
    "memory_check": bool,
    "priors": Literal["all", "none"],
    "ckpt": str | Path | None,
    "objective": str,
    "scene": str | None,
    "outputs": str | Path,
    "decoder_precision": Literal["auto", "float32", "bfloat16"],
    "kernels": Literal["auto", "torch"],
}
# A part that cannot be loaded ends the command with one line; Hydra would log it before.
logging.getLogger("hydra.utils").setLevel(logging.CRITICAL)
# Hydra's own keys in a part's config.
RESERVED = {"_target_", "_partial_", "_convert_", "_recursive_", "_args_"}
# Pydantic's names of a key that does not exist, of a value whose class no config value has, and of
# a key that a row of settings lacks, which is left to the part itself.
UNKNOWN = ("extra_forbidden", "unexpected_keyword_argument")
BUILT = ("needs_python_object", "is_instance_of")
LEFT = ("missing", "missing_argument")
REFERENCE = re.compile(r"\$\{([\w.]+)\}")

Node = Mapping[Any, Any]


def check_config(config: DictConfig) -> None:
    """Check that every value is set, belongs to a part, and has the type that the part expects.

    They are checked as JSON: a list is any sequence, text is a path.

    Raises:
        DevrfError: naming the key at fault and what was expected.
    """
    # Imported here: --help is answered before it has loaded.
    from pydantic import TypeAdapter, ValidationError

    from devrf.system.options import expectation

    raw: Any = OmegaConf.to_container(config)
    text = json.dumps(raw, default=str, ensure_ascii=False)
    for key in sorted(OmegaConf.missing_keys(config)) if MISSING in text else ():
        value = "PATH" if key.endswith("root") else "VALUE"
        raise DevrfError(f"{key}: required; give {key}={value}")
    resolved: Any = OmegaConf.to_container(config, resolve=True)
    read = tuple(f"{key}." for key in REFERENCE.findall(text))
    # A key that is missing is wrong in its type, too.
    content = json.dumps(dict.fromkeys(ROOT) | resolved, default=str)
    try:
        TypeAdapter(_type_of(raw, resolved, "", read)).validate_json(content, strict=True)
    except ValidationError as error:
        issues = [issue for issue in error.errors() if not _is_left_to_the_part(issue)]
        for issue in sorted(issues, key=lambda issue: issue["type"] not in UNKNOWN):
            where, beside = _place(raw, issue["loc"])
            if issue["type"] in UNKNOWN:
                lacking = [other["loc"][-1] for other in error.errors() if other["type"] in LEFT]
                raise unknown_key(where, [*beside, *lacking]) from None
            alike = [other["msg"] for other in issues if _place(raw, other["loc"])[0] == where]
            value = issue["input"]
            said = expectation(alike, repr(value))
            choices = re.findall("'([^']+)'", said.rpartition(", not ")[0])
            meant = did_you_mean(value, choices, f"{where}=")
            if issue["type"] in BUILT:
                said = f"expected a section with _target_, not {value!r}"
            raise DevrfError(f"{where}: {said}{meant}") from None


def _is_left_to_the_part(issue: Mapping[str, Any]) -> bool:
    """Whether only building the part tells if pydantic is right: a row's keys, a part's class."""
    return issue["type"] in LEFT or (issue["type"] in BUILT and _is_part(issue["input"]))


def _type_of(raw: Node, resolved: Node, path: str, read: tuple[str, ...]) -> Any:
    """The type of a node: a part's has its settings, another's the keys that parts read of it.

    A value outside any part counts as read when some part refers to it: ``${loss.search}``.
    """
    hints = _settings(resolved, path) if _is_part(raw) else {} if path else dict(ROOT)
    for key, value in raw.items():
        where = f"{path}{key}."
        if _is_part(raw) and key not in hints:
            hints |= {key: Any} if "**" in hints else {}
        elif isinstance(value, Mapping) and (_is_part(value) or not _is_part(raw)):
            hints[key] = _type_of(value, resolved[key], where, read)
        elif _is_part(resolved[key]):
            hints[key] = Any  # checked in its own place
        elif key not in hints and (value is None or where.startswith(read)):
            hints[key] = Any
    made = cast(Any, TypedDict)(path, hints, total=False)
    made.__pydantic_config__ = {"extra": "forbid", "arbitrary_types_allowed": True}
    return made


def _place(raw: Node, names: Iterable[object]) -> tuple[str, Node]:
    """The key at which the user sets a value of a config, and the mapping that holds it."""
    where = ""
    node = cast(Any, raw)
    beside = raw
    for name in map(str, names):  # some name one of several types
        if isinstance(node, Mapping) and name in node:
            beside = node
            node = node[name]
            where = f"{where}.{name}".lstrip(".")
            if isinstance(node, str) and (reference := REFERENCE.fullmatch(node)):
                where = reference[1]
                node = reduce(getitem, where.split("."), raw)
    return where, beside


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
        raise DevrfError(f"{path}_target_: cannot load {target!r} ({error})") from None
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


def unknown_key(where: str, keys: Iterable[object]) -> DevrfError:
    """The error for a key that does not exist, with the closest one that does."""
    name = where.rpartition(".")[2]
    meant = did_you_mean(name, (key for key in keys if key != name), where[: -len(name)])
    group, _, key = where.partition(".")
    files = sorted((config_folder() / group).glob("*.yaml"))
    having: list[str] = []
    deeper: list[str] = []
    for path in files:
        # As plain data: a DictConfig does not "contain" a required key that is not given.
        settings: Any = OmegaConf.to_container(OmegaConf.load(path))
        flat = set(_below(settings))
        having += [path.stem] * (key in flat)
        deeper += [f"{group}.{other}" for other in flat if other.partition(".")[2] == key]
    instead = f"it belongs to {group}={', '.join(having)}" if having else ""
    instead = instead or f"it is {' or '.join(dict.fromkeys(deeper))}" * bool(deeper)
    instead = instead or "--cfg job shows every key there is"
    return DevrfError(f"{where}: no such key{meant or f'; {instead}'}")


def _below(node: Node, path: str = "") -> Iterator[str]:
    """The keys below a node, with dots between them."""
    for name, value in node.items():
        yield f"{path}{name}"
        if isinstance(value, Mapping):
            yield from _below(value, f"{path}{name}.")


def check_extras(config: DictConfig) -> None:
    """Refuse by a DevrfError settings for which an extra of devrf is not installed."""
    # A browser draws DeVRF's scenes by itself.
    served = ("server",) if config.method == "devrf" else ("server", "auto")
    serves = config.stage == "view" and config.viewer.renderer in served
    tensorboard = "tensorboard" in (config.get("logger") or ())
    exports = config.stage == "export" and config.export.format != "html"
    meshes = "skimage trimesh fast_simplification"
    usd = exports and config.export.format == "usd"
    for is_used, setting, packages, extra, instead in (
        (tensorboard, "logger=tensorboard", "tensorboard", "tensorboard", "logger=csv"),
        (serves, "stage=view", "viser", "viewer", "stage=render"),
        (config.viewer.get("training"), "viewer=true", "viser", "viewer", "viewer=false"),
        (exports, "stage=export", meshes, "export", "stage=render"),
        (usd, "export.format=usd", "pxr", "export", "export.format=gltf"),
    ):
        for package in packages.split():
            if is_used and find_spec(package) is None:
                raise DevrfError(
                    f"{setting}: {package} is not installed; run pip install "
                    f'"devrf[{extra}]", or set {instead}'
                )
