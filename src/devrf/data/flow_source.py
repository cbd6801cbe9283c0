"""Where a scene's optical flow comes from: its files, an estimate, or nowhere."""

from __future__ import annotations

import importlib.util
import logging
from dataclasses import replace
from pathlib import Path
from typing import Literal, get_args

from devrf.scenes.optical_flow import camera_turn, estimate_flow
from devrf.scenes.scene import Scene

log = logging.getLogger(__name__)

FlowSource = Literal["auto", "files", "dis", "raft", "none"]
# Of layouts that have no place for flow files.
EstimatedFlow = Literal["auto", "dis", "raft", "none"]
ESTIMATED = get_args(EstimatedFlow)

# Images taken in directions that differ by more show too little in common for optical flow.
JUMP_DEGREES = 10.0


def files_or_none(source: FlowSource) -> Literal["files", "none"]:
    """Whether a reader is to read flow files."""
    return "files" if source in ("auto", "files") else "none"


def with_flow(scene: Scene, source: FlowSource, cache: Path | None) -> Scene:
    """The scene with estimated flow of its moving training views, if that is asked for.

    It is valid only at pixels that count.

    Args:
        scene: as its reader gave it, with flow from files or without.
        source: ``dis`` and ``raft`` estimate; ``auto`` keeps what was read from files, else
            estimates with DIS where OpenCV is installed and the cameras do not jump from a
            frame to the next; the others change nothing.
        cache: an ``.npz`` that keeps the estimate, or None.

    Raises:
        DevrfError: what :func:`devrf.scenes.optical_flow.estimate_flow` raises.
    """
    train = scene.dynamic.train
    method = source
    if method == "auto" and train.flow is None:
        method, how = "dis", "estimated with DIS"
        if not importlib.util.find_spec("cv2"):
            method, how = "none", 'left out (OpenCV is not installed: pip install "devrf[flow]")'
        elif camera_turn(train) > JUMP_DEGREES:
            method, how = "none", "left out (the cameras jump from frame to frame)"
        log.info("%s: no optical flow files; flow is %s", scene.name, how)
    if method not in ("dis", "raft"):
        return scene
    flow = estimate_flow(train, method, cache)
    if train.valid_mask is not None:
        flow = replace(flow, valid=flow.valid & train.valid_mask)
    dynamic = replace(scene.dynamic, train=replace(train, flow=flow))
    return replace(scene, dynamic=dynamic)
