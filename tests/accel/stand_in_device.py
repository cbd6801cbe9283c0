"""``python -m devrf`` on a CUDA device that is not there: ``python stand_in_device.py ARGUMENTS``.

Tensors of the device say that they are on it, and are computed on the CPU. What a GPU refuses is
refused: an operation on tensors of both devices, numbers drawn by the other device's generator,
a tensor of the device as a NumPy array; and, while a captured graph is replayed, whatever waits
for the device, copies from or to the host, or draws numbers. A replay runs the Python code again:
numbers and addresses that a real graph freezes may change unseen. Triton's kernels run in its
interpreter (``TRITON_INTERPRET=1``), which knows no bfloat16: the device is one without it.

``LD_PRELOAD`` has to name the library made of ``stand_in_device.cpp``, which tells torch about the
device. Nothing is timed, and no memory is measured.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager, nullcontext
from types import SimpleNamespace
from typing import Any
from unittest.mock import MagicMock, patch

import torch
import torch._dynamo  # notes torch's functions, before some are replaced
from torch import Tensor
from torch.utils._python_dispatch import TorchDispatchMode, return_and_correct_aliasing
from torch.utils._pytree import tree_leaves, tree_map
from triton.runtime.interpreter import GridExecutor

from devrf.cli.main import entry
from devrf.system.graphs import CudaGraphCapture

DEVICE, HOST = torch.device("cuda", 0), torch.device("cpu")
# Operations that take tensors of both devices: copies, and indices into a tensor of the device.
MIXING = {"copy_", "_to_copy", "index", "index_put_", "_index_put_impl_"}
# Operations that wait until the device knows how long their result is, or what it is.
WAITING = {"_local_scalar_dense", "nonzero", "masked_select", "_unique2", "unique_dim", "bincount"}
WAITING |= {"repeat_interleave", "equal"}
# The devices of generators, by their addresses: torch wraps them anew.
generators: dict[int, torch.device] = {}
replaying: list[bool] = []


class OnDevice(Tensor):
    """A tensor of the device.

    Attributes:
        on_host: its numbers.
    """

    on_host: Tensor

    @staticmethod
    def __new__(cls, on_host: Tensor) -> OnDevice:
        """Wrap a tensor of the host."""
        how: dict[str, Any] = {"strides": on_host.stride(), "dtype": on_host.dtype}
        how["storage_offset"] = on_host.storage_offset()
        made: Any = Tensor._make_wrapper_subclass(cls, on_host.shape, **how, device=DEVICE)
        made.on_host = on_host
        return made  # type: ignore[no-any-return]

    __torch_function__ = torch._C._disabled_torch_function_impl

    @classmethod
    def __torch_dispatch__(cls, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        return computed(func, args, kwargs or {})

    def data_ptr(self) -> int:
        return self.on_host.data_ptr()

    def tolist(self) -> Any:
        waits("tolist")
        return self.on_host.tolist()

    def numpy(self, *args: Any, **kwargs: Any) -> Any:
        raise TypeError("a tensor of the device is no NumPy array")

    __array__ = numpy

    def is_pinned(self, *args: Any) -> bool:
        return False

    def record_stream(self, stream: object) -> None:
        pass


class Everywhere(TorchDispatchMode):  # type: ignore[no-untyped-call]
    """Sees what no tensor of the device takes part in, too: what makes one."""

    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        return computed(func, args, kwargs or {})


def computed(func: Any, args: Sequence[Any], kwargs: dict[str, Any]) -> Any:
    """What an operation gives, on the device that a GPU would give it on, or why it would not."""
    name = func._schema.name.removeprefix("aten::")
    leaves = tree_leaves((args, kwargs))
    tensors = [leaf for leaf in leaves if isinstance(leaf, Tensor)]
    ours = [tensor for tensor in tensors if isinstance(tensor, OnDevice)]
    to = kwargs.get("device")
    first = args[0] if args and isinstance(args[0], Tensor) else None
    if to is None:
        to = first.device if name in MIXING and first is not None else DEVICE if ours else HOST
    to = torch.device(to)
    theirs = [t for t in tensors if not isinstance(t, OnDevice)]
    if ours and (any(t.dim() for t in theirs) and name not in MIXING):
        raise RuntimeError(f"{name}: tensors of both devices")
    if name.startswith(("index", "_index")) and ours and not isinstance(first, OnDevice):
        raise RuntimeError(f"{name}: indices of the device into a tensor of the host")
    for leaf in leaves:
        if isinstance(leaf, torch.Generator):
            of = generators.get(leaf._cdata, HOST)
            if of.type != to.type or replaying:
                raise RuntimeError(f"{name}: numbers of {of} on {to}, replaying: {replaying}")
    if replaying and ours:
        flags = args[1] if name.startswith(("index", "_index")) and len(args) > 1 else ()
        sized = isinstance(flags, (list, tuple)) and any(
            isinstance(index, Tensor) and index.dtype in (torch.bool, torch.uint8)
            for index in flags
        )
        crosses = name in MIXING and bool(any(t.dim() for t in theirs) or to.type == "cpu")
        if name in WAITING or sized or crosses:
            raise RuntimeError(f"{name}: not while a graph is replayed")
    elif replaying and to.type == "cuda" and tensors:
        raise RuntimeError(f"{name}: a copy from the host while a graph is replayed")
    if name in ("_pin_memory", "pin_memory"):
        return first
    given = {**kwargs, **({"device": HOST} if kwargs.get("device") is not None else {})}
    if given.get("pin_memory"):
        given["pin_memory"] = False
    plain = tree_map(lambda leaf: leaf.on_host if isinstance(leaf, OnDevice) else leaf, args)
    given = tree_map(lambda leaf: leaf.on_host if isinstance(leaf, OnDevice) else leaf, given)
    result = func(*plain, **given)
    if to.type == "cpu":
        return result
    wrapped = tree_map(
        lambda leaf: OnDevice(leaf) if type(leaf) is Tensor else leaf,
        result,
    )
    return return_and_correct_aliasing(func, args, kwargs, wrapped) if ours else wrapped


class Generator(torch.Generator):
    """Draws numbers on either device."""

    def __new__(cls, device: Any = "cpu") -> Generator:
        made = super().__new__(cls, "cpu")
        generators[made._cdata] = torch.device(device)
        return made

    def __init__(self, device: Any = "cpu") -> None:
        pass

    @property
    def device(self) -> torch.device:  # type: ignore[override]
        return generators[self._cdata]


def waits(name: str) -> None:
    """Refuse what waits for the device while a graph is replayed."""
    if replaying:
        raise RuntimeError(f"{name}: not while a graph is replayed")


def captured(self: CudaGraphCapture, work: Any) -> Any:
    """A graph whose replay runs the work."""

    def replay() -> None:
        replaying.append(True)
        try:
            work()
        finally:
            replaying.clear()

    return SimpleNamespace(replay=replay)


def run_kernel(self: Any, *args: Any, usual: Any = GridExecutor.__call__, **kwargs: Any) -> None:
    """A kernel's launch, in Triton's interpreter."""
    usual(self, *(a.on_host if isinstance(a, OnDevice) else a for a in args), **kwargs)


@contextmanager
def device() -> Iterator[None]:
    """Within its context there is the device."""
    default = Generator(DEVICE)
    gib = 2**30
    nothing = dict.fromkeys(("memory_reserved", "memory_allocated"), lambda *_: 0)
    nothing |= dict.fromkeys(("max_memory_allocated", "max_memory_reserved"), lambda *_: 0)
    does_nothing = ("empty_cache", "set_stream", "set_device", "manual_seed_all")
    does_nothing += ("manual_seed", "reset_peak_memory_stats", "init", "_lazy_init")
    pretended: dict[str, Any] = {
        **nothing,
        **dict.fromkeys(does_nothing, lambda *_, **__: None),
        **dict.fromkeys(("stream", "device", "device_of"), lambda *_: nullcontext()),
        **dict.fromkeys(("is_available", "is_initialized"), lambda: True),
        **dict.fromkeys(("Stream", "Event", "current_stream"), MagicMock()),
        "synchronize": lambda *_: waits("synchronize"),
        "device_count": lambda: 1,
        "current_device": lambda: 0,
        "is_bf16_supported": lambda *_, **__: False,
        "is_current_stream_capturing": lambda: bool(replaying),
        "get_device_capability": lambda *_: (7, 5),
        "get_device_name": lambda *_: "a device that is not there",
        "mem_get_info": lambda *_: (16 * gib, 16 * gib),
        "cudart": lambda: SimpleNamespace(
            cudaHostRegister=lambda *_: 0, cudaHostUnregister=lambda *_: 0
        ),
        "get_rng_state": lambda *_: default.get_state(),
        "set_rng_state": lambda state, *_: default.set_state(state),
        "get_rng_state_all": lambda: [default.get_state()],
        "set_rng_state_all": lambda states: default.set_state(states[0]),
    }
    # Tensors of the host that become tensors of the device are of another class.
    torch.__future__.set_overwrite_module_params_on_conversion(True)
    torch._C._set_only_lift_cpu_tensors(True)  # so that the copy of torch.tensor(…) is seen
    with ExitStack() as stack:
        for name, value in pretended.items():
            stack.enter_context(patch.object(torch.cuda, name, value))
        stack.enter_context(patch.object(torch, "Generator", Generator))
        stack.enter_context(patch.object(CudaGraphCapture, "capture", captured))
        stack.enter_context(patch.object(GridExecutor, "__call__", run_kernel))
        stack.enter_context(Everywhere())  # type: ignore[no-untyped-call]
        yield


if __name__ == "__main__":
    with device():
        entry()
