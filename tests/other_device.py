"""A second device that every machine has: its tensors live in the same memory, and refuse to meet those of the CPU.

It stands in for a GPU. Arithmetic is the CPU's own, so results are the same bits; what fails on a GPU fails here: an
operation on tensors of both devices, or `.numpy()` on one that was not brought back. It is stricter in one way: indices
must be on the device of what they index. Single numbers (tensors of no dimension) may come from the CPU, as on a GPU.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager, nullcontext
from importlib import import_module
from typing import Any

import numpy as np
import pytest
import torch
from torch.overrides import TorchFunctionMode
from torch.utils._python_dispatch import TorchDispatchMode, return_and_correct_aliasing
from torch.utils._pytree import tree_leaves, tree_map_only

ELSEWHERE = torch.device("meta")
"""Its name: that of torch's device without memory, which needs no driver and which nothing of ours uses."""
CROSSING = ("_to_copy", "copy_")
"""What may see tensors of both devices."""
SETS_DATA = torch.Tensor.data.__set__  # type: ignore[attr-defined]


class Far(torch.Tensor):
    """A tensor that says it is elsewhere, around one that is not."""

    near: torch.Tensor

    @staticmethod
    def __new__(cls, near: torch.Tensor) -> Far:
        layout: dict[str, Any] = {"strides": near.stride(), "storage_offset": near.storage_offset()}
        made: Far = torch.Tensor._make_wrapper_subclass(cls, near.shape, dtype=near.dtype, device=ELSEWHERE, **layout)
        made.near = near
        return made

    def __init__(self, near: torch.Tensor) -> None: ...

    @classmethod
    def __torch_dispatch__(cls, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:  # type: ignore[override]
        return _run(func, args, kwargs or {})


class _Operations(TorchDispatchMode):  # type: ignore[no-untyped-call]
    """Sees all operations, those that make tensors out of nothing too."""

    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        return _run(func, args, kwargs or {})


class _Calls(TorchFunctionMode):
    """What torch does before its operations, and does otherwise for this device than for a GPU."""

    def __torch_function__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        kwargs = dict(kwargs or {})
        if func in (torch.tensor, torch.as_tensor) and kwargs.get("device") == ELSEWHERE:
            del kwargs["device"]
            learned = kwargs.pop("requires_grad", False)
            return func(*args, **kwargs).to(ELSEWHERE).requires_grad_(learned)
        if func is torch.Tensor.new_tensor and isinstance(args[0], Far):
            return torch.tensor(args[1], dtype=kwargs.get("dtype", args[0].dtype)).to(ELSEWHERE)
        if func == torch.Tensor.tolist and isinstance(args[0], Far):
            return args[0].near.tolist()
        if func == SETS_DATA and isinstance(args[1], Far) and not isinstance(args[0], Far):
            old, new = args
            if isinstance(old, torch.nn.Parameter):
                new = torch.nn.Parameter(new, old.requires_grad)
            torch.utils.swap_tensors(old, new)  # type: ignore[no-untyped-call]
            return None
        return func(*args, **kwargs)


def _run(func: Any, args: Any, kwargs: dict[str, Any]) -> Any:
    tensors = [t for t in tree_leaves((args, kwargs)) if isinstance(t, torch.Tensor)]
    name, far = func.overloadpacket.__name__, any(isinstance(t, Far) for t in tensors)
    near = [t for t in tensors if not isinstance(t, Far) and t.dim()]
    if far and near and name not in CROSSING:
        raise AssertionError(f"{func} meets tensors of both devices: one of shape {tuple(near[0].shape)} is on the CPU")
    wanted, inner = kwargs.get("device"), dict(kwargs)
    if wanted is not None:
        far = torch.device(wanted) == ELSEWHERE
        inner["device"] = torch.device("cpu")
    elif name == "copy_":
        far = isinstance(args[0], Far)
    inner_args, inner = tree_map_only(Far, lambda t: t.near, (args, inner))
    out = func(*inner_args, **inner)
    if not far:
        return out
    out = tree_map_only(torch.Tensor, Far, out)
    return return_and_correct_aliasing(func, args, kwargs, out)  # type: ignore[no-untyped-call]


def _autocast(device_type: str, *args: Any, **options: Any) -> Any:
    """Products of low precision are left to devices that torch knows."""
    known = device_type != ELSEWHERE.type
    return torch.amp.autocast(device_type, *args, **options) if known else nullcontext()


@contextmanager
def elsewhere() -> Iterator[torch.device]:
    """The device, inside a block."""
    with pytest.MonkeyPatch.context() as patch, _Operations(), _Calls():  # type: ignore[no-untyped-call]
        # Fused Adam asks for devices by name, and modules replace parameters of another class unless told to swap.
        patch.setattr(
            import_module("torch.optim.optimizer"),
            "_get_fused_kernels_supported_devices",
            lambda: ["cpu", ELSEWHERE.type],
        )
        patch.setattr(torch, "autocast", _autocast)
        before = torch.__future__.get_swap_module_params_on_conversion()
        torch.__future__.set_swap_module_params_on_conversion(True)
        try:
            yield ELSEWHERE
        finally:
            torch.__future__.set_swap_module_params_on_conversion(before)


def both(what: Callable[[torch.device], Any]) -> tuple[Any, Any]:
    """What is found on the CPU, and on the other device."""
    here = what(torch.device("cpu"))
    with elsewhere() as device:
        return here, what(device)


def values(state: Any) -> Any:
    """A state with its tensors as arrays, wherever they lie."""
    if isinstance(state, torch.Tensor):
        return (state.near if isinstance(state, Far) else state).detach().numpy()
    if isinstance(state, dict):
        return {name: values(value) for name, value in state.items()}
    return [values(value) for value in state] if isinstance(state, list) else state


def assert_same(found: Any, expected: Any, rounding: float = 0.0) -> None:
    """Equal, of nested dicts and lists; to the bit, unless torch takes other kernels for a device."""
    if isinstance(expected, dict):
        assert found.keys() == expected.keys()
        found, expected = list(found.values()), list(expected.values())
    if isinstance(expected, list | tuple):
        for one, other in zip(found, expected, strict=True):
            assert_same(one, other, rounding)
    elif expected is None or isinstance(expected, str):
        assert found == expected
    else:
        np.testing.assert_allclose(found, expected, rtol=rounding, atol=rounding)
