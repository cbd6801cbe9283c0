"""A scene's optical flow, from files or estimated, and the images that it leads to."""

from __future__ import annotations

import logging
from dataclasses import replace
from pathlib import Path

import torch
from torch import Tensor

from devrf.scenes.optical_flow import estimate_flow, frame_pairs
from devrf.scenes.reader import FlowSource
from devrf.scenes.scene import OpticalFlow, Scene, Views
from devrf.scenes.validation import scene_error

log = logging.getLogger(__name__)


def with_flow(scene: Scene, source: FlowSource, cache: Path | None) -> Scene:
    """The scene with flow of its moving training views, estimated if ``source`` says so.

    Estimated flow is valid only where the views' ``valid_mask`` is, flow from files only in images
    whose view has one a frame earlier.

    Args:
        scene: as its reader gave it, with flow from files or without.
        source: ``dis`` and ``raft`` estimate; the others change nothing.
        cache: an ``.npz`` file for the estimate, or None.

    Raises:
        DevrfError: ``files`` of a scene in motion that has none.
    """
    train = scene.dynamic.train
    if source in ("dis", "raft"):
        flow = estimate_flow(train, source, cache)
        return _with_train(scene, replace(train, flow=_where_valid(flow, train)))
    if scene.moves and train.flow is None:
        if source == "files":
            raise scene_error("data.flow", "files: the scene has none; set data.flow=auto")
        log.info("%s: learned without optical flow", scene.name)
    if train.flow is None:
        return scene
    flow = _from_frame_to_frame(train.flow, train)
    return scene if flow is train.flow else _with_train(scene, replace(train, flow=flow))


def with_forward_flow(
    scene: Scene, source: FlowSource, cache: Path | None, files: OpticalFlow | None
) -> Scene:
    """The scene with forward flow of its moving training views, if it has a source.

    It comes from the same source as backward flow (:func:`with_flow`).

    Args:
        scene: with backward flow, or without.
        source: as of :func:`with_flow`.
        cache: an ``.npz`` beside which the estimate is kept, or None.
        files: forward flow from files, or None.
    """
    train = scene.dynamic.train
    flow = None if files is None else _from_frame_to_frame(files, train, forward=True)
    if flow is None and source in ("dis", "raft"):
        if cache is not None:
            cache = cache.with_name(f"{cache.stem}_forward{cache.suffix}")
        flow = estimate_flow(train, source, cache, forward=True)
    if flow is None:
        return scene
    return _with_train(scene, replace(train, forward_flow=_where_valid(flow, train)))


def _from_frame_to_frame(flow: OpticalFlow, views: Views, *, forward: bool = False) -> OpticalFlow:
    """The flow, valid only in images whose view has an image one frame earlier; or later.

    Where a camera has left a frame out, its file leads to the frame before that.
    """
    leads = torch.zeros(len(views), dtype=torch.bool)
    leads[[pair[forward] for pair in frame_pairs(views)]] = True
    lost = (flow.valid.flatten(1).any(dim=1) & ~leads).nonzero()[:, 0].tolist()
    if not lost:
        return flow
    log.warning(
        "flow of %d images is left out, as of %s: its camera has no image one frame %s",
        len(lost),
        views.names[lost[0]],
        "later" if forward else "earlier",
    )
    return replace(flow, valid=flow.valid & leads[:, None, None])


def _where_valid(flow: OpticalFlow, views: Views) -> OpticalFlow:
    """The flow, valid only within the views' ``valid_mask``."""
    if views.valid_mask is None:
        return flow
    return replace(flow, valid=flow.valid & views.valid_mask)


def _with_train(scene: Scene, train: Views) -> Scene:
    """The scene with other moving training views."""
    return replace(scene, dynamic=replace(scene.dynamic, train=train))


def previous_images(views: Views) -> Tensor:
    """The image that the backward flow of each of N images leads to.

    That is the image before it in the same view; a moving camera's images (each its own view)
    are one sequence. An image without a predecessor is its own.

    Returns:
        (N,) int64 on the device of the views.
    """
    previous = torch.arange(len(views), device=views.times.device)
    for image, earlier in frame_pairs(views):
        previous[image] = earlier
    return previous
