"""Every kernel compiles for NVIDIA's GPUs without one, and spills no register."""

from __future__ import annotations

import inspect
import pkgutil
import struct
import sys
from importlib import import_module
from pathlib import Path

import pytest
import torch
import warp as wp

import devrf.kernels
from devrf.kernels.runtime import is_supported, row_type

# Densities, displacements, features.
CHANNELS = (1, 3, 12)
# Whether it is contracted.
SPACES = (False, True)
# Whether images have an alpha mask.
ALPHAS = (False, True)
# Ampere, Hopper, Blackwell: no kernel has code of an architecture's own, so others do, too.
ARCHITECTURES = (80, 90, 120)
# Attributes of a kernel in a cubin's .nv.info (EIATTR_REGCOUNT, EIATTR_FRAME_SIZE).
REGISTERS, FRAME = 0x2F, 0x11
Numbers = row_type(64)


def every_kernel() -> dict[str, wp.Kernel]:
    """All kernels by names of their own; a factory's, for each number of channels or space."""
    found: dict[str, wp.Kernel] = {}
    for info in pkgutil.iter_modules(devrf.kernels.__path__):
        module = import_module(f"devrf.kernels.{info.name}")
        for name, value in vars(module).items():
            if getattr(value, "__module__", module.__name__) != module.__name__:
                continue  # another module's
            if isinstance(value, wp.Kernel):
                if value.func.__module__ == module.__name__:
                    found[f"{info.name}.{name}"] = value
            elif hasattr(value, "__wrapped__"):
                signature = inspect.signature(value)
                if signature.return_annotation in (wp.Kernel, "wp.Kernel"):
                    (what,) = signature.parameters
                    choices = {"channels": CHANNELS, "contracted": SPACES, "has_alpha": ALPHAS}[
                        what
                    ]
                    found |= {f"{info.name}.{name}_{one}": value(one) for one in choices}
    return found


@wp.kernel(enable_backward=False)
def fits_no_registers(first: int, result: wp.array(dtype=float)):
    """Numbers that are looked up by an index do not fit registers: the check sees local memory."""
    numbers = Numbers()
    for k in range(64):
        numbers[(first * k) % 64] = float(k)
    result[first] = numbers[first]


@pytest.fixture(scope="module")
def together() -> wp.Module:
    """All kernels in one module: the compiler reads Warp's own functions once, not for each."""
    assert is_supported(torch.zeros(1))  # starts Warp
    module = wp.get_module("devrf_kernels_together")
    kernels = every_kernel() | {"fits_no_registers": fits_no_registers}
    module.made = {
        name: wp.Kernel(
            kernel.func, key=name.replace(".", "_"), module=module, options=kernel.options
        )
        for name, kernel in kernels.items()
    }
    return module


def attributes(cubin: bytes) -> dict[str, dict[int, int]]:
    """The number of registers, and bytes of local memory, of each function in a cubin, an ELF."""
    (start,) = struct.unpack_from("<Q", cubin, 40)
    size, count, names = struct.unpack_from("<HHH", cubin, 58)
    # Of each section its name's place, and where it begins and how long it is.
    heads = [struct.unpack_from("<I20xQQ", cubin, start + k * size) for k in range(count)]

    def text(table: int, place: int) -> str:
        begin = table + place
        return cubin[begin : cubin.index(b"\0", begin)].decode()

    sections = {text(heads[names][1], name): (at, length) for name, at, length in heads}
    symbols, strings = sections[".symtab"][0], sections[".strtab"][0]
    at, length = sections[".nv.info"]
    stop = at + length
    found: dict[str, dict[int, int]] = {}
    while at < stop:
        form, attribute, size = struct.unpack_from("<BBH", cubin, at)
        if form == 4 and attribute in (REGISTERS, FRAME):
            symbol, value = struct.unpack_from("<II", cubin, at + 4)
            (name,) = struct.unpack_from("<I", cubin, symbols + 24 * symbol)
            found.setdefault(text(strings, name), {})[attribute] = value
        at += 4 + (size if form == 4 else 0)  # the other forms have their value in ``size``
    return found


def test_all_are_found() -> None:
    trilinear = ("interpolate_kernel", "slope_kernel", "add_kernel")
    names = {f"trilinear.{one}_{n}" for one in trilinear for n in CHANNELS}
    steps = ("adam_kernel", "total_variation_kernel")
    names |= {f"adam.{one}_{n}" for one in steps for n in CHANNELS}
    names |= {f"march.march_kernel_{n}" for n in SPACES}
    march = ("adjoint_kernel", "keep_significant_kernel", "scatter_kernel")
    names |= {f"march.{one}" for one in march}
    names |= {"compositing.composite_kernel", "photometric.photometric_kernel"}
    names |= {"deformation.cycle_kernel", "deformation.flow_kernel"}
    names |= {f"pixels.look_up_kernel_{n}" for n in ALPHAS}
    splatting = ("project", "list", "composite", "composite_adjoint", "project_adjoint")
    names |= {f"splatting.{one}_kernel" for one in splatting}
    assert set(every_kernel()) == names


@pytest.mark.skipif(sys.platform == "darwin", reason="Warp has no compiler for CUDA there")
@pytest.mark.parametrize("architecture", ARCHITECTURES)
def test_every_kernel_compiles_without_spills(
    together: wp.Module, architecture: int, tmp_path: Path
) -> None:
    (made,) = wp.compile_aot_module(together, arch=architecture, module_dir=tmp_path, use_ptx=False)
    assert made.suffix == ".cubin"
    of = attributes(made.read_bytes())
    compiled = {
        name: of[f"{kernel.get_mangled_name()}_cuda_kernel_forward"]
        for name, kernel in together.made.items()
    }
    print(f"\nsm_{architecture}: registers and bytes of local memory of a thread")
    for name, each in compiled.items():
        print(f"{each[REGISTERS]:4} {each[FRAME]:4} {name}")
    # No kernel has an array of its own: local memory would hold registers that are spilled.
    assert compiled.pop("fits_no_registers")[FRAME] >= 64 * 4
    assert {name for name, each in compiled.items() if each[FRAME]} == set()
    # Two blocks of 256 threads fit a multiprocessor's 65,536.
    assert max(each[REGISTERS] for each in compiled.values()) <= 128
