"""How a lack of memory shows, and what it says."""

from __future__ import annotations

import re

import pytest
import torch

from devrf.system.out_of_memory import gib, is_oom, numbers

GPU = "CUDA out of memory. Tried to allocate 20.00 MiB. GPU 0 has a total capacity of 23.68 GiB"
HOST = "DefaultCPUAllocator: can't allocate memory: you tried to allocate 1073741824 bytes. Error"


@pytest.mark.parametrize(
    ("error", "short"),
    [
        (torch.OutOfMemoryError(GPU), True),
        (MemoryError(), True),
        (RuntimeError(f"[enforce fail at alloc_cpu.cpp:121] data. {HOST} code 12"), True),
        (RuntimeError("CUDA error: out of memory"), True),
        (RuntimeError("CUDA error: CUBLAS_STATUS_ALLOC_FAILED when calling"), True),
        (RuntimeError("std::bad_alloc"), True),
        (RuntimeError("could not create a primitive"), True),
        (RuntimeError("mat1 and mat2 shapes cannot be multiplied"), False),
        (ValueError("out of memory"), False),
    ],
)
def test_what_is_out_of_memory(error: BaseException, short: bool) -> None:
    assert is_oom(error) is short


def test_what_torch_itself_says_is_understood() -> None:
    with pytest.raises(RuntimeError) as caught:
        torch.empty(2**60, dtype=torch.uint8)
    assert is_oom(caught.value)
    assert numbers(str(caught.value), torch.device("cpu")).startswith("1073741824.0 GiB more asked")


@pytest.mark.parametrize(("said", "asked"), [(GPU, "0.02"), (HOST, "1.0")])
def test_the_numbers(said: str, asked: str) -> None:
    words = numbers(said, torch.device("cpu"))
    assert re.fullmatch(rf"{asked} GiB more asked, [\d.]+ GiB free on cpu", words)


def test_an_unknown_amount_is_left_out() -> None:
    assert re.fullmatch(r"[\d.]+ GiB free on cpu", numbers("std::bad_alloc", torch.device("cpu")))


@pytest.mark.parametrize(
    ("count", "words"), [(21.34 * 2**30, "21.3"), (1.16 * 2**30, "1.2"), (0.0342 * 2**30, "0.034")]
)
def test_bytes_in_gib(count: float, words: str) -> None:
    assert gib(count) == words
