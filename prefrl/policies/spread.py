"""A model that is spread over ranks: each keeps a share of every weight, and has a layer whole only while it runs.

Variant: torch's FSDP2 (`fully_shard`; ZeRO stage 3, Rajbhandari et al. 2020), one group for each block of the model and
one for the rest. Gradients are sums over ranks, not means: what ranks compute are shares of one loss. Left out: shares
that wait in the memory of the CPU, and communication in half precision.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

import torch
from torch import Tensor
from torch.distributed.device_mesh import init_device_mesh
from torch.distributed.fsdp import FSDPModule, fully_shard
from torch.distributed.tensor import DTensor, distribute_tensor
from transformers import PreTrainedModel

from prefrl.distributed import joined, world
from prefrl.seeding import to_host


class Spread:
    """What `prefrl.policies.language.Whole` does, for models that are spread; every rank has to come to all of it."""

    fast = False
    """Decoding fast keeps copies of the weights, and the other shortcuts run parts of a model; its shares are gathered
    for the whole."""

    def place(self, model: PreTrainedModel, device: torch.device) -> None:
        """Spread a model block by block: no device ever has it whole."""
        mesh = init_device_mesh(device.type, (joined().size,))
        blocks = set(model._no_split_modules or ())  # transformers' names of the classes
        for module in list(model.modules()):
            if type(module).__name__ in blocks:
                fully_shard(module, mesh=mesh)
        # The rest too is given back after each pass: what is registered as the model's are always the shares.
        fully_shard(model, mesh=mesh, reshard_after_forward=True)
        for module in model.modules():
            if isinstance(module, FSDPModule):
                module.set_gradient_divide_factor(1.0)
                module.set_force_sum_reduction_for_comms(True)  # gloo knows no other

    @contextmanager
    def running(self, model: PreTrainedModel) -> Iterator[None]:
        """Meanwhile each rank runs the model as often as it needs to, without gradients.

        A pass of one needs the shares of all: ranks that are done first keep the others company, with passes that
        nobody reads.
        """
        # Before anything is gathered, as where ranks that are done ask.
        going_on = model.register_forward_pre_hook(_say_so, prepend=True)
        try:
            yield
        finally:
            going_on.remove()
        token = torch.zeros(1, 1, dtype=torch.int64, device=model.device)
        while world().any(False):
            model(input_ids=token, use_cache=False)

    def whole(self, value: Tensor) -> Tensor:
        """A copy of a parameter, or of what belongs to it, in the memory of the CPU."""
        found: Tensor = value.full_tensor() if isinstance(value, DTensor) else value.clone()
        return to_host(found)

    def share(self, value: Tensor, of: Tensor) -> Tensor:
        """This rank's share of a whole tensor that is the same on all ranks, as that of a parameter."""
        if not isinstance(of, DTensor):
            return value
        return distribute_tensor(value.to(of.device), of.device_mesh, of.placements, src_data_rank=None)


def _say_so(*_: object) -> None:
    """Tell the ranks that are done that this one is not."""
    world().any(True)
