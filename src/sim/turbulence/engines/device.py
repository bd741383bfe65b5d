"""How numbers reach a device and how exactly they are multiplied there."""

from collections.abc import Iterator, Mapping
from contextlib import contextmanager

import torch
from torch import Tensor

ALIGNED = 16  # bytes


@contextmanager
def full_float32() -> Iterator[None]:
    """Multiply matrices in float32 proper: TF32 and autocast would cost a phase three digits."""
    products = torch.backends.cuda.matmul
    before, products.allow_tf32 = products.allow_tf32, False
    try:
        with torch.autocast("cuda", enabled=False):
            yield
    finally:
        products.allow_tf32 = before


def moved(here: Tensor, device: torch.device) -> Tensor:
    """Return a tensor on a device; the CPU goes on while it is copied there."""
    if device.type == "cuda" and here.device.type == "cpu":
        here = here.pin_memory()
    return here.to(device, non_blocking=True)


class Packed:
    """Tensors of the CPU by name, in one piece of memory: a single copy takes them to a device."""

    def __init__(self, tables: Mapping[str, Tensor]):
        self.places, end = {}, 0
        for name, part in tables.items():
            self.places[name] = slice(end, end + part.nbytes), part.dtype, part.shape
            end += -(-part.nbytes // ALIGNED) * ALIGNED
        self.memory = torch.zeros(end, dtype=torch.uint8)
        for name, part in tables.items():
            place = self.memory[self.places[name][0]]
            place.copy_(part.contiguous().flatten().view(torch.uint8))

    def on(self, device: torch.device) -> dict[str, Tensor]:
        """Return the tensors on `device`."""
        there = moved(self.memory, device)
        return {
            name: there[place].view(dtype).view(shape)
            for name, (place, dtype, shape) in self.places.items()
        }
