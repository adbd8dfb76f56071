"""The processes of a run: one, or those that `accelerate launch` started, each with its own streams.

The little that is shared at every step (rewards, successes) goes through the CPU (Gloo), gradients through
whatever Accelerate chose for the policy's device (NCCL on GPUs).
"""

from __future__ import annotations

import datetime as dt
import os
from collections.abc import Iterable, Iterator, Sequence
from typing import Any

import numpy as np
import torch
import torch.distributed as dist
from torch import Tensor

TIMEOUT = dt.timedelta(hours=1)
"""How long a process waits for the others: while the first one writes a checkpoint, say."""

BUCKET_BYTES = 64 * 2**20
"""Gradients travel in pieces of about this size."""


class Ranks:
    """The processes of a run, which run in step: all but `share_of` and `own...` waits until all have called it.

    Args:
        rank: of this one, from 0.
        count: of all, on all nodes.
        local_count: of those on this node.
    """

    def __init__(self, rank: int = 0, count: int = 1, local_count: int = 1) -> None:
        self.rank, self.count, self.local_count = rank, count, local_count
        self._control = dist.new_group(backend="gloo", timeout=TIMEOUT) if count > 1 else None

    @property
    def is_main(self) -> bool:
        """Whether this is the one that logs and writes."""
        return self.rank == 0

    def share_of(self, num_envs: int) -> slice:
        """The streams of this process among `num_envs`.

        Raises:
            ValueError: they cannot be shared out evenly.
        """
        if num_envs % self.count:
            raise ValueError(f"--num_envs={num_envs}, of all processes, must be a multiple of {self.count}.")
        size = num_envs // self.count
        return slice(self.rank * size, (self.rank + 1) * size)

    def own(self, name: str) -> str:
        """`name` for what every process has of its own: the first one's is `name` itself."""
        return name if self.is_main else f"{name}/process_{self.rank}"

    def own_seed(self, seed: int) -> int:
        """`seed` for the global generators of this process: the first one's is `seed` itself.

        The others' are not `seed` + rank, which are those of another run's processes.
        """
        return seed if self.is_main else int(np.random.SeedSequence([seed, self.rank]).generate_state(1)[0])

    def concatenate(self, array: np.ndarray, axis: int = 0) -> np.ndarray:
        """All processes' arrays, of one shape and type, joined along `axis` in the order of the ranks."""
        if self.count == 1:
            return array
        own = torch.from_numpy(np.ascontiguousarray(array).reshape(-1).view(np.uint8))
        parts = [torch.empty_like(own) for _ in range(self.count)]
        dist.all_gather(parts, own, group=self._control)
        arrays = [part.numpy().view(array.dtype).reshape(array.shape) for part in parts]
        return np.concatenate(arrays, axis=axis)

    def gather(self, value: Any) -> list[Any]:
        """All processes' values, in the order of the ranks."""
        values = [value] * self.count
        if self.count > 1:
            dist.all_gather_object(values, value, group=self._control)
        return values

    def gather_to_main(self, value: Any) -> list[Any]:
        """All processes' values, in the order of the ranks, in the first process; its own in every other."""
        values = [value] * self.count if self.is_main else None
        if self.count > 1:
            dist.gather_object(value, values, dst=0, group=self._control)
        return values or [value]

    def collect(self, array: np.ndarray) -> np.ndarray:
        """All processes' arrays, joined along axis 0, in the first process; its own in every other."""
        return array if self.count == 1 else np.concatenate(self.gather_to_main(array))

    def broadcast(self, value: Any, source: int = 0) -> Any:
        """The value of process `source`."""
        values = [value]
        if self.count > 1:
            dist.broadcast_object_list(values, src=source, group=self._control)
        return values[0]

    def average_gradients(self, parameters: Sequence[Tensor]) -> None:
        """Replace every gradient by its mean over the processes; one that a process has not counts as 0."""
        if self.count == 1:
            return
        has_gradient = np.array([[parameter.grad is not None for parameter in parameters]])
        gradients = []
        for i in np.flatnonzero(self.concatenate(has_gradient).any(axis=0)):
            if parameters[i].grad is None:
                parameters[i].grad = torch.zeros_like(parameters[i])
            gradients.append(parameters[i].grad)
        for bucket in _buckets(gradients):
            mean = torch.cat([gradient.reshape(-1) for gradient in bucket]) / self.count
            dist.all_reduce(mean)
            for gradient, part in zip(bucket, mean.split([gradient.numel() for gradient in bucket]), strict=True):
                gradient.copy_(part.view_as(gradient))

    def copy_from_main(self, tensors: Iterable[Tensor]) -> None:
        """Overwrite `tensors` by those of the first process."""
        self.copy_from(0, tensors)

    def copy_from(self, source: int, tensors: Iterable[Tensor]) -> None:
        """Overwrite `tensors` by those of process `source`."""
        if self.count == 1:
            return
        for tensor in tensors:
            contiguous = tensor.detach().contiguous()
            dist.broadcast(contiguous, src=source)
            tensor.detach().copy_(contiguous)

    def check_alike(self, state: dict[str, Any]) -> None:
        """Check that `state` is the same in all processes.

        Raises:
            RuntimeError: it is not; a run that went on would be neither one run nor several.
        """
        for rank, other in enumerate(self.gather(state)):
            if other != state:
                names = sorted(name for name in state | other if state.get(name) != other.get(name))
                raise RuntimeError(
                    f"Processes {self.rank} and {rank} no longer agree on: {', '.join(names)}. Task orders and "
                    "reset strategies of your own must decide alike in every process: by the loop's state, the "
                    "environment's answers and the generator they are given, and nothing else."
                )

    def leave(self) -> None:
        """Part from the other processes."""
        if self.count > 1:
            dist.destroy_process_group()


def join_ranks(device: str | None) -> Ranks:
    """Join the processes that `accelerate launch` (or torchrun) started; one process without it.

    Args:
        device: of the policy; `cpu` keeps Accelerate from taking a GPU.
    """
    if int(os.environ.get("WORLD_SIZE", "1")) == 1:
        return Ranks()
    from accelerate import Accelerator, InitProcessGroupKwargs

    accelerator = Accelerator(cpu=device == "cpu", kwargs_handlers=[InitProcessGroupKwargs(timeout=TIMEOUT)])
    if accelerator.num_processes == 1:
        return Ranks()
    local_count = int(os.environ.get("LOCAL_WORLD_SIZE", "1"))
    return Ranks(accelerator.process_index, accelerator.num_processes, local_count)


def choose_gpu(device: str | None) -> None:
    """Make the policy's GPU PyTorch's current one, of which alone LeRobot keeps and restores the generator.

    Args:
        device: of the policy; without a number (`cuda`), as of any other, the current one stays.
    """
    place = torch.device(device or "cpu")
    if place.type == "cuda" and place.index is not None:
        torch.cuda.set_device(place)


def bit_sum(tensors: Iterable[Tensor]) -> int:
    """A number that tells tensors apart down to the last bit, whatever device adds it up."""
    as_int = {1: torch.uint8, 2: torch.int16, 4: torch.int32, 8: torch.int64}
    sums = [t.detach().contiguous().view(as_int[t.element_size()]).sum(dtype=torch.int64) for t in tensors]
    return int(torch.stack(sums).sum())


def _buckets(tensors: Iterable[Tensor]) -> Iterator[list[Tensor]]:
    """Group neighbours of one type and device up to BUCKET_BYTES."""
    bucket: list[Tensor] = []
    for tensor in tensors:
        is_alike = bucket and (tensor.dtype, tensor.device) == (bucket[0].dtype, bucket[0].device)
        if bucket and not (is_alike and sum(t.nbytes for t in [*bucket, tensor]) <= BUCKET_BYTES):
            yield bucket
            bucket = []
        bucket.append(tensor)
    if bucket:
        yield bucket
