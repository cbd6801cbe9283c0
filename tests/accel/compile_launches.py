"""Compiles what the check of the kernels launches for GPUs that need not be there.

    compile_launches.py two|all CAPABILITY…

compiles ``two`` of the kernels, or all with all constants that they are launched with. Run by
test_compilation.py in a process of its own, without Triton's interpreter: the operations are called
on CPU tensors, their launches are recorded instead of run, then each is compiled to PTX and on to a
cubin by the assembler in Triton's wheel. Fails if a kernel was not compiled.
"""

from __future__ import annotations

import inspect
import re
import subprocess
import sys
from importlib import import_module
from pathlib import Path
from pkgutil import iter_modules
from typing import Any

import torch
import triton
from triton.backends.compiler import GPUTarget
from triton.compiler import ASTSource
from triton.runtime.jit import JITFunction

import devrf.accel
from devrf.ops import dispatch
from devrf.ops.check import CASES, Draw

TWO = {"warped_depth_kernel", "composite_backward_kernel"}
TWO_CASES = [*CASES["warped_depth"], *CASES["compositing"]]

POINTERS = {
    torch.float32: "*fp32",
    torch.float64: "*fp64",
    torch.float16: "*bf16",  # the interpreter's half precision is another than a GPU's
    torch.int32: "*i32",
    torch.int64: "*i64",
    torch.uint8: "*u8",
}
recorded: dict[tuple[Any, ...], tuple[ASTSource, dict[str, Any]]] = {}


def record(kernel: JITFunction, *args: Any, grid: Any, warmup: bool, **kwargs: Any) -> None:
    """Keep a kernel with the types and constants that it is launched with."""
    known = ("num_warps", "enable_fp_fusion")
    options = {name: kwargs.pop(name) for name in known if name in kwargs}
    given = inspect.signature(kernel.fn).bind(*args, **kwargs).arguments
    signature, constants = {}, {}
    for parameter in kernel.params:
        value = given[parameter.name]
        if parameter.is_constexpr:
            constants[parameter.name] = value
        else:
            signature[parameter.name] = type_of(value)
    key = (kernel.fn.__name__, *signature.items(), *constants.items())
    if "constexprs" in inspect.signature(ASTSource).parameters:
        # From Triton 3.3 on constants have their place in the signature.
        order = [parameter.name for parameter in kernel.params]
        signature = {name: signature.get(name, "constexpr") for name in order}
    recorded[key] = (ASTSource(kernel, signature, constants), options)


def type_of(value: Any) -> str:
    if isinstance(value, torch.Tensor):
        assert value.is_contiguous()
        return POINTERS[value.dtype]
    return "fp32" if isinstance(value, float) else "i32"


def kernel_names() -> set[str]:
    """Every kernel of the package, as opposed to the functions that kernels call."""
    modules = [import_module(m.name) for m in iter_modules(devrf.accel.__path__, "devrf.accel.")]
    return {name for module in modules for name in vars(module) if name.endswith("_kernel")}


def registers(ptx: str, capability: int) -> tuple[int, int]:
    """Registers of a thread, and the bytes that it spills, as the assembler reports them."""
    assembler = Path(triton.backends.nvidia.__file__).parent / "bin" / "ptxas"
    command = [assembler, "-v", f"--gpu-name=sm_{capability}", "-", "-o", "/dev/null"]
    # Some instructions are those of one architecture alone, sm_90a.
    command[2] += "a" if capability >= 90 else ""
    done = subprocess.run(command, input=ptx, capture_output=True, text=True, check=True)
    spilled = sum(map(int, re.findall(r"(\d+) bytes spill", done.stderr)))
    return int(re.findall(r"Used (\d+) registers", done.stderr)[0]), spilled


def main(extent: str, capabilities: list[int]) -> None:
    names = TWO if extent == "two" else kernel_names()
    JITFunction.run = record
    dispatch.reaches = lambda device: True
    draw = Draw(torch.device("cpu"))
    with dispatch.using("triton"):
        for case in (
            TWO_CASES if extent == "two" else [c for cases in CASES.values() for c in cases]
        ):
            case(draw)
    compiled = set()
    for (name, *_), (source, options) in recorded.items():
        if extent == "two" and name not in names - compiled:
            continue
        for capability in capabilities:
            asm = triton.compile(source, GPUTarget("cuda", capability, 32), options).asm
            assert f".target sm_{capability}" in asm["ptx"] and asm["cubin"][:4] == b"\x7fELF"
            used, spilled = registers(asm["ptx"], capability)
            most = 128 if options.get("num_warps") == 1 else 255
            told = f"{name} on sm_{capability}: {used} registers, {spilled} bytes spilled"
            assert used <= most and not spilled, told
            print(told)
        compiled.add(name)
    assert compiled == names, names - compiled


main(sys.argv[1], [int(argument) for argument in sys.argv[2:]])
