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
from typing import Any, Literal, Union, get_args, get_origin, get_type_hints

from hydra.utils import get_object
from omegaconf import DictConfig, OmegaConf

from devrf.cli.config import config_folder
from devrf.errors import DevrfError, did_you_mean

# Keys outside the parts.
ROOT: dict[str, Any] = {
    "stage": str,
    "method": str,
    "profile": str | None,
    "seed": int,
    "resume": bool,
    "memory_check": bool,
    "priors": Literal["all", "none"],
    "ckpt": str | Path | None,
    "objective": str,
    "scene": str,
    "kernels": Literal["auto", "torch", "triton"],
    "graphs": Literal["auto", "off"],
    "decoder_precision": Literal["auto", "float32", "bfloat16"],
}
# Keys that were renamed, and their new names; what is below them has kept its name.
RENAMED = {
    "capture.mattes": "capture.alpha_masks",
    "capture.moments": "capture.max_timesteps",
    "schedule.deformation.sides": "schedule.deformation.levels.N.side",
    "schedule.deformation.iterations_per_frame": "schedule.deformation.levels.N.iterations",
    "schedule.deformation.parallel_frames": "schedule.deformation.levels.N.parallel_frames",
    "schedule.deformation.rates": "schedule.deformation.levels.N.lr_factor",
    "schedule.deformation.fall": "schedule.deformation.levels.N.lr_final_factor",
    "schedule.canonical.carve": "schedule.canonical.visual_hull_init",
    "schedule.canonical.contracted_start": "schedule.canonical.unbounded_initial_side",
    "schedule.canonical.directions_from": "schedule.canonical.view_dependence_start",
    "schedule.canonical.doublings": "schedule.canonical.upsample_at",
    "schedule.canonical.least_views": "schedule.canonical.min_views",
    "schedule.motion.moments": "schedule.motion.adam_state",
    "schedule.motion.start": "schedule.extensions.tracks.init_from",
    "schedule.appearance": "schedule.extensions.color_residual",
    "loss.deformation.matte": "loss.deformation.alpha_mask",
    "loss.fine.matte": "loss.fine.alpha_mask",
    "ray_stage.schedule.moments": "ray_stage.schedule.times_per_batch",
    "ray_stage.model.settings.warmup.least_frames": "ray_stage.model.settings.warmup.min_frames",
    "ray_stage.model.settings.warmup.most_frames": "ray_stage.model.settings.warmup.max_frames",
    "callbacks.health": "callbacks.divergence_guard",
    "callbacks.saving": "callbacks.checkpoint",
    "callbacks.curve": "callbacks.training_curve",
}
# What cannot be loaded ends the command with one line; Hydra would log it before.
logging.getLogger("hydra.utils").setLevel(logging.CRITICAL)
# Hydra's own keys in a part's config.
RESERVED = {"_target_", "_partial_", "_convert_", "_recursive_", "_args_"}
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
    for key, hint in ROOT.items():
        _check_value(key, resolved.get(key), hint)
    if not 0 <= resolved["seed"] < 2**32:
        raise DevrfError(f"seed: expected 0 to {2**32 - 1}, not {resolved['seed']}")
    # A value outside any part counts as read when some part refers to it: ${loss.search}.
    _check_node(raw, resolved, "", {*ROOT, *REFERENCE.findall(OmegaConf.to_yaml(config))})


def _check_node(raw: Node, resolved: Node, path: str, read: set[str]) -> None:
    """Check a part by its signature; of another node the parts below, and that values are read."""
    settings = _settings(resolved, path) if "_target_" in raw else None
    for key in (key for key in raw if key not in RESERVED):
        where, raw_value, value = f"{path}{key}", raw[key], resolved[key]
        if settings is not None and key not in settings and "**" not in settings:
            raise unknown_key(where, settings)
        if isinstance(raw_value, Mapping) and (settings is None or "_target_" in raw_value):
            _check_node(raw_value, value, f"{where}.", read)
        elif settings is None:
            if value is not None and not any(f"{where}.".startswith(f"{ref}.") for ref in read):
                below = (ref.removeprefix(path) for ref in read if ref.startswith(path))
                known = {*map(str, raw), *(name.split(".")[0] for name in below)}
                raise unknown_key(where, known - {str(key)})
        elif not (isinstance(value, Mapping) and "_target_" in value):
            hint, default = settings.get(key, (Any, None))
            # The key to name is the one where the user sets the value.
            reference = REFERENCE.fullmatch(raw_value) if isinstance(raw_value, str) else None
            if value != default:
                _check_value(reference.group(1) if reference else where, value, hint)


def _settings(part: Node, path: str) -> dict[str, tuple[Any, Any]]:
    """Type and default of each key of a part, by name; ``**`` if it takes any name."""
    settings = _parameters(str(part["_target_"]), path)
    for below in part.values():
        if "**" in settings and isinstance(below, Mapping) and below.get("_partial_"):
            # It is made later, of the keys beside it.
            settings = {**_parameters(str(below["_target_"]), path), **settings}
            del settings["**"]
    return settings


def _parameters(target: str, path: str) -> dict[str, tuple[Any, Any]]:
    try:
        part = get_object(target)
        parameters = inspect.signature(part).parameters
    except Exception as error:
        raise DevrfError(f"{path}_target_: cannot load {target!r} ({error})") from None
    try:
        # A dataclass may inherit fields whose types only its base's module knows.
        own_init = inspect.isclass(part) and not is_dataclass(part)
        hints = get_type_hints(part.__init__ if own_init else part)
    except (NameError, TypeError):  # names imported only for a type checker
        hints = {}
    return {
        "**" if p.kind is p.VAR_KEYWORD else p.name: (hints.get(p.name, Any), p.default)
        for p in parameters.values()
    }


def _check_value(where: str, value: object, hint: Any) -> None:
    row = next((kind for kind in (hint, *get_args(hint)) if is_dataclass(kind)), None)
    by_name = get_origin(hint) in (dict, Mapping)
    if isinstance(value, Mapping) and (by_name or row is not None):
        hints = dict.fromkeys(value, get_args(hint)[1]) if by_name else get_type_hints(row)
        for key, entry in value.items():
            if key not in hints:
                raise unknown_key(f"{where}.{key}", hints)
            _check_value(f"{where}.{key}", entry, hints[key])
    elif expected := unfit(value, hint):
        meant = did_you_mean(value, choices_of(hint), f"{where}=")
        raise DevrfError(f"{where}: expected {expected}, not {value!r}{meant}")


def unknown_key(where: str, known: Iterable[object]) -> DevrfError:
    """The error for a key that does not exist, with the closest one that does."""
    for old, new in RENAMED.items():
        if f"{where}.".startswith(f"{old}."):
            return DevrfError(f"{where}: renamed; write {new}{where.removeprefix(old)}=VALUE")
    name = where.rpartition(".")[2]
    meant = did_you_mean(name, (k for k in known if k != "**"), where[: -len(name)])
    group = where.removesuffix(f".{name}")
    files = sorted((config_folder() / group).glob("*.yaml"))
    having = ", ".join(path.stem for path in files if name in OmegaConf.load(path))
    instead = f"it belongs to {group}={having}" if having else "--cfg job shows every key there is"
    return DevrfError(f"{where}: no such key{meant or f'; {instead}'}")


def unfit(value: object, hint: Any) -> str:
    """What a parameter annotated ``hint`` takes instead of ``value``; empty where that fits.

    Text counts as a path, a list as any sequence, a whole number as a number. A type that no config
    value has takes any.
    """
    # Imported here: --help is answered before it has loaded.
    from pydantic import ConfigDict, PydanticUserError, TypeAdapter, ValidationError

    try:
        adapter = TypeAdapter(hint, config=ConfigDict(arbitrary_types_allowed=True))
        # As JSON: of Python objects, strictly, text would be no path and a list no tuple.
        adapter.validate_json(json.dumps(value, default=str), strict=True)
    except PydanticUserError:  # a hint that pydantic does not know
        return ""
    except ValidationError as error:
        if any(issue["type"] == "needs_python_object" for issue in error.errors()):
            return ""
        wanted = (issue["msg"].removeprefix("Input should be ") for issue in error.errors())
        return " or ".join(dict.fromkeys(wanted))
    return ""


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
    return choices_of(_settings(node, f"{parent}.").get(name, (None,))[0])


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
