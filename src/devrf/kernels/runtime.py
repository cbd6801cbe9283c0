"""Support of tensors by kernels, and launches.

NVIDIA Warp compiles a kernel's Python source when it is first launched, and keeps the result on
disk, in ``WARP_CACHE_PATH`` or the user's cache folder, if nobody else may write there. A kernel
has a thread for each ray, sample or voxel. Warp runs these one after another on a CPU; so each of
torch's threads takes a part, except of additions to grids.
"""

from __future__ import annotations

import logging
import os
import stat
import tempfile
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from functools import cache, wraps
from itertools import pairwise
from pathlib import Path
from threading import RLock, local
from typing import Any, Literal

import torch
import warp as wp
from torch import Tensor

from devrf.errors import DevrfError

log = logging.getLogger(__name__)

# The hot operations' implementation: torch: their definitions in PyTorch; auto: Warp's kernels
# where they run.
Kernels = Literal["auto", "torch"]
_chosen: Kernels = "auto"
# Fewer threads of a kernel take less time than another core takes to begin with them, 0.1 ms: at
# points of a grid or a ray, and where a thread follows a ray.
GRAIN = 4096
GRAIN_OF_RAYS = 256
# Held by whoever makes, compiles or loads a kernel.
compiling = RLock()
_of_thread = local()


def choose(kernels: Kernels, *, deterministic: bool = False) -> None:
    """Choose the implementation of this process's hot operations, before the first of them.

    Args:
        kernels: Warp's where they run, or PyTorch.
        deterministic: on a GPU, have atomic additions in the same order each time; slower.
    """
    global _chosen
    _chosen = kernels
    modes = wp.DeterministicMode
    wp.config.deterministic = modes.RUN_TO_RUN if deterministic else modes.NOT_GUARANTEED


def is_supported(tensor: Tensor) -> bool:
    """Whether kernels run on ``tensor``: single precision, on a CPU or one of NVIDIA's GPUs."""
    here = tensor.is_cpu or (tensor.is_cuda and torch.version.hip is None)
    wanted = _chosen == "auto" and here and tensor.dtype == torch.float32
    if wanted:
        with compiling:
            _begin()
    return wanted


def launch(
    kernel: wp.Kernel,
    count: int,
    inputs: Sequence[Any],
    device: torch.device,
    grain: int | None = GRAIN,
) -> None:
    """Run ``kernel(first, *inputs)`` with ``count`` threads, of which thread k is ``first`` + k.

    A CPU runs parts of ``grain`` threads or more side by side, the first of them in this thread.
    None: it runs one part; else no two threads may write to the same address. This thread prepares
    the inputs once, so that the others begin at once.

    Warp sees tensors as :func:`array` has them, and checks them at the first launch alone: that
    takes longer than a small launch runs. Later ones write addresses and numbers in their place.
    """
    if device.type == "cuda" and wp.config.deterministic != wp.DeterministicMode.NOT_GUARANTEED:
        # A recorded launch would order the additions to the arrays that it was recorded with.
        stream = _stream(torch.cuda.current_stream(device))
        wp.launch(kernel, count, inputs=[0, *_arrays(inputs)], device=str(device), stream=stream)
        return
    parts = _parts(device, count, grain)
    edges = [count * part // parts for part in range(parts + 1)]
    commands = _commands(kernel, parts, inputs, device)
    begin, *others = commands
    for index, value in enumerate(inputs, 1):
        parameter = begin.params[index + 1]
        if isinstance(value, Tensor):
            assert value.is_contiguous()
            parameter.data = value.data_ptr()
            parameter.shape[0] = _rows(value)
        elif isinstance(value, wp.array):
            parameter.data = value.ptr
            parameter.shape[0] = value.shape[0]
        elif isinstance(value, int | float):
            parameter.value = value
        else:
            begin.set_param_at_index(index, value)
    for other in others:
        other.params[2:] = begin.params[2:]
    for command, (first, stop) in zip(commands, pairwise(edges), strict=True):
        command.params[1].value = first
        if command.bounds.size != stop - first:
            command.set_dim(stop - first)
    running = [_pool().submit(other.launch) for other in others]
    if device.type == "cuda":
        begin.launch(_stream(torch.cuda.current_stream(device)))
    else:
        begin.launch()
    for other in running:
        other.result()


def array(tensor: Tensor, kind: Any = None) -> wp.array:
    """A contiguous tensor (N,) of numbers, or (…, C) of rows, as Warp's array of N; not a copy.

    ``kind`` is Warp's type of a row; None: that of C such numbers. The array is made from the
    address, in a fifth of the time of ``wp.from_torch``: 6 µs in place of 30.
    """
    assert tensor.is_contiguous()
    if kind is None:
        kind = wp.dtype_from_torch(tensor.dtype)
        if tensor.ndim > 1:
            kind = row_type(tensor.shape[-1], kind)
    made = wp.array(
        ptr=tensor.data_ptr(),
        dtype=kind,
        shape=(_rows(tensor),),
        device=str(tensor.device),
        copy=False,
    )
    made.tensor = tensor  # the memory lives as long
    return made


def empty_structs(kind: Any, count: int, device: torch.device) -> wp.array:
    """Memory for ``count`` of a Warp struct of four-byte numbers, from torch's allocator."""
    floats = wp.types.type_size_in_bytes(kind) // 4
    return array(torch.empty(count, floats, device=device), kind)


def cached_kernel(factory: Callable[[int], wp.Kernel]) -> Callable[[int], wp.Kernel]:
    """A ``factory`` of kernels, for a number of channels or a space, that makes each once."""
    made = cache(factory)

    @wraps(factory)
    def kernel(choice: int) -> wp.Kernel:
        with compiling:
            return made(choice)

    return kernel


@cache
def row_type(channels: int, number: Any = wp.float32) -> Any:
    """Warp's type of a row of ``channels`` numbers."""
    is_point = channels == 3 and number is wp.float32
    return wp.vec3 if is_point else wp.types.vector(length=channels, dtype=number)


def _rows(tensor: Tensor) -> int:
    return tensor.shape[:-1].numel() if tensor.ndim > 1 else len(tensor)


def _commands(
    kernel: wp.Kernel, parts: int, inputs: Sequence[Any], device: torch.device
) -> list[wp.Launch]:
    """This thread's launches of a kernel with tensors of these types, one a part, made once.

    Warp finds, compiles and loads a kernel, and checks the types, in one thread at a time.
    """
    made = _of_thread.__dict__.setdefault("commands", {})
    types = tuple(
        (v.dtype, v.shape[-1] if v.ndim > 1 else 1) for v in inputs if isinstance(v, Tensor)
    )
    commands: list[wp.Launch] = made.setdefault((kernel, device, types), [])
    while len(commands) < parts:
        values = [0, *_arrays(inputs)]
        with compiling:
            command = wp.launch(kernel, 1, inputs=values, device=str(device), record_cmd=True)
        command.fwd_args = None  # these tensors are not to live as long
        commands.append(command)
    return commands[:parts]


def _arrays(inputs: Sequence[Any]) -> list[Any]:
    return [array(value) if isinstance(value, Tensor) else value for value in inputs]


@cache
def _stream(stream: torch.cuda.Stream) -> wp.Stream:
    """One of torch's streams as a stream of Warp's."""
    return wp.stream_from_torch(stream)


def _parts(device: torch.device, count: int, grain: int | None) -> int:
    """Number of parts of a launch of ``count`` threads."""
    if device.type != "cpu" or grain is None:
        return 1
    return max(min(torch.get_num_threads(), count // grain), 1)


@cache
def _pool() -> ThreadPoolExecutor:
    return ThreadPoolExecutor(os.cpu_count(), thread_name_prefix="devrf-kernels")


@cache
def _begin() -> None:
    """Start Warp, with a cache of compiled kernels that can be written.

    Raises:
        DevrfError: its library cannot be loaded, as where memory is short.
    """
    wp.config.log_level = wp.LOG_ERROR
    with _silent():
        try:
            wp.init()
        except OSError:
            wp.config.kernel_cache_dir = _own_folder()
            wp.init()
        except RuntimeError as error:
            why = error.__cause__ or error
            instead = "free memory, or give kernels=torch"
            raise DevrfError(f"kernels: Warp cannot be loaded ({why}); {instead}") from error
    folder = Path(wp.config.kernel_cache_dir)
    if not os.access(folder, os.W_OK) or others_may_write(folder):
        wp.config.kernel_cache_dir = own = _own_folder()
        why = "cannot be written, or others may write there"
        log.warning("%s: %s; kernels are kept in %s", folder, why, own)


def others_may_write(folder: Path) -> bool:
    """Whether other users may write to a folder, or put another in its place."""
    for path in (folder, *folder.parents):
        info = path.stat()
        # Many systems give each user a group of the same number.
        others = stat.S_IWOTH | (0 if info.st_gid == info.st_uid else stat.S_IWGRP)
        if info.st_mode & others and (path == folder or not info.st_mode & stat.S_ISVTX):
            return True
    return folder.stat().st_uid != os.getuid()


def _own_folder() -> str:
    """A folder of this user among temporary files; DevrfError if others may write there, too."""
    folder = Path(tempfile.gettempdir()) / f"devrf-kernels-{os.getuid()}"
    folder.mkdir(mode=0o700, exist_ok=True)
    if folder.is_symlink() or others_may_write(folder):
        raise DevrfError(f"{folder}: others may write there; remove it, or set WARP_CACHE_PATH")
    return str(folder)


@contextmanager
def _silent() -> Iterator[None]:
    """Discard the standard error: without a GPU Warp's libraries write to it."""
    stderr = os.dup(2)
    nothing = os.open(os.devnull, os.O_WRONLY)
    os.dup2(nothing, 2)
    try:
        yield
    finally:
        os.dup2(stderr, 2)
        os.close(stderr)
        os.close(nothing)
