"""The names that ``stage=…`` takes; without heavy imports, for messages and completion."""

from __future__ import annotations

from omegaconf import OmegaConf

from devrf.cli.config import config_folder
from devrf.errors import did_you_mean

PIPELINE = "pipeline"
# Stages that learn nothing; the protocol's stages come beside these.
STEPS = (
    *("prepare", "inspect", "evaluate", "render", "still", "view", "export"),
    *("report", "fetch", "capture", "selfcheck"),
)
# Of these, what uses a checkpoint.
OF_A_CHECKPOINT = ("evaluate", "render", "still", "view", "export")
# What users of other programs write, and what it is here.
SYNONYMS = {
    **dict.fromkeys(("train", "fit", "learn", "run", "start"), "stage=pipeline"),
    **dict.fromkeys(("eval", "test", "score", "metrics"), "stage=evaluate"),
    **dict.fromkeys(("video", "film"), "stage=render"),
    **dict.fromkeys(("viewer", "browser", "viser", "gui"), "stage=view"),
    **dict.fromkeys(("image", "picture", "photo"), "stage=still"),
    **dict.fromkeys(("download", "get"), "stage=fetch"),
    **dict.fromkeys(("mesh", "gltf", "convert"), "stage=export"),
    **dict.fromkeys(("footage", "colmap", "sfm", "process"), "stage=capture"),
    **dict.fromkeys(("check", "info", "show"), "stage=inspect"),
    **dict.fromkeys(("compare", "table"), "stage=report"),
    **dict.fromkeys(("doctor", "diagnose", "self-check"), "stage=selfcheck"),
    "help": "--help",
    "version": "--version",
}


def known_stages() -> list[str]:
    """Every stage there is, of all protocols."""
    learning: dict[str, None] = {}  # in order, each once
    for path in sorted((config_folder() / "protocol").glob("*.yaml"), reverse=True):
        learning |= dict.fromkeys(OmegaConf.select(OmegaConf.load(path), "stages"))
    return [PIPELINE, *learning, *STEPS]


def meant_stage(word: str) -> str:
    """The end of a message: which stage may have been meant by ``word``; else empty."""
    if word.lower() in SYNONYMS:
        return f"; did you mean {SYNONYMS[word.lower()]}?"
    return did_you_mean(word, known_stages(), "stage=")
