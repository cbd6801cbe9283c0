"""Where a scene's optical flow comes from (files, an estimate, nowhere), and where it leads."""

from __future__ import annotations

import logging
from dataclasses import replace
from pathlib import Path

import torch
from torch import Tensor

from devrf.scenes.optical_flow import FlowMethod, camera_turn, estimate_flow, frame_pairs
from devrf.scenes.reader import FlowSource
from devrf.scenes.scene import OpticalFlow, Scene, Views

log = logging.getLogger(__name__)

# Images taken in directions that differ by more show too little in common for optical flow.
JUMP_DEGREES = 10.0


def with_flow(scene: Scene, source: FlowSource, cache: Path | None) -> Scene:
    """The scene with estimated flow of its moving training views, if that is asked for.

    It is valid only where the views' ``valid_mask`` is.

    Args:
        scene: as its reader gave it, with flow from files or without.
        source: ``dis`` and ``raft`` estimate; ``auto`` keeps what was read from files, else
            estimates with DIS unless the cameras jump from frame to frame, no view has two frames
            in a row, or the scene is at rest; the others change nothing.
        cache: an ``.npz`` that keeps the estimate, or None.
    """
    train = scene.dynamic.train
    method = source
    if not scene.moves and method == "auto":
        return scene
    if method == "auto" and train.flow is None:
        method, how = "dis", "estimated with DIS"
        if not frame_pairs(train):
            method, how = "none", "left out (no view has two frames in a row)"
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


def with_forward_flow(
    scene: Scene, source: FlowSource, cache: Path | None, files: OpticalFlow | None
) -> Scene:
    """The scene with forward flow of its moving training views, where it can be had.

    It is had as backward flow is: see :func:`with_flow`.

    Args:
        scene: with backward flow, or without.
        source: as of :func:`with_flow`.
        cache: an ``.npz`` beside which the estimate is kept, or None.
        files: what was read from files, if any.
    """
    train, flow = scene.dynamic.train, files
    possible = bool(frame_pairs(train)) and camera_turn(train) <= JUMP_DEGREES
    if flow is None and possible and source in ("auto", "dis", "raft"):
        if cache is not None:
            cache = cache.with_name(f"{cache.stem}_forward{cache.suffix}")
        method: FlowMethod = "raft" if source == "raft" else "dis"
        flow = estimate_flow(train, method, cache, forward=True)
    if flow is None:
        return scene
    if train.valid_mask is not None:
        flow = replace(flow, valid=flow.valid & train.valid_mask)
    return replace(scene, dynamic=replace(scene.dynamic, train=replace(train, forward_flow=flow)))


def previous_images(views: Views) -> Tensor:
    """For each of N images the one that its backward flow leads to.

    That is the image before it in the same view; a moving camera's images (each its own view)
    follow one another as one sequence. An image without a predecessor is its own.

    Returns:
        (N,) int64 on the device of the views.
    """
    previous = torch.arange(len(views), device=views.times.device)
    for image, earlier in frame_pairs(views):
        previous[image] = earlier
    return previous
