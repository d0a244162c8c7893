"""Random numbers in a batch: each request draws with its own seed, as if it ran alone."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any, override

import torch
from ibrobot_terminal.plural import counted
from torch.overrides import TorchFunctionMode

_OF_SIZE = frozenset({"randn", "rand"})
_OF_TENSORS = frozenset({"randn_like", "rand_like", "multinomial", "bernoulli", "normal_", "uniform_", "bernoulli_"})
_NORMAL = "normal"
"""Random functions that take a size, or tensors."""

type Draw = tuple[str, int]
"""Name of a function, and the first dimension of its result."""


class NotByRequest(Exception):
    """The rows of a draw cannot be assigned to the requests of a batch."""


class Draws(TorchFunctionMode):  # type: ignore[misc]  # torch has no types here
    """A context in which random functions draw the rows of each request with that request's seed.

    A request's rows equal those that it would draw alone, bit by bit. Unknown functions draw from the global
    generator; see `escaped`.

    Args:
        seeds: seeds of the requests in the batch, in order.
        device: device of the network; its generator is used in addition to the CPU's.
        alone: the draws of a single request, from `made`. A batch of one may draw anything.
    """

    def __init__(self, seeds: Sequence[int], device: torch.device, alone: Sequence[Draw] = ()) -> None:
        super().__init__()
        self.made: list[Draw] = []
        self._generators = [torch, *([getattr(torch, device.type)] if device.type in ("cuda", "mps") else [])]
        self._alone = alone
        self._states = []
        for seed in seeds:
            torch.manual_seed(seed)
            self._states.append(self._state())
        self._outside = self._states[-1]

    @property
    def escaped(self) -> bool:
        """Whether a function drew from the global generator."""
        return not all(torch.equal(a, b) for a, b in zip(self._outside, self._state(), strict=True))

    @override
    def __torch_function__(
        self, func: Callable[..., Any], types: Any, args: Sequence[Any] = (), kwargs: Mapping[str, Any] | None = None
    ) -> Any:
        kwargs, name = dict(kwargs or {}), getattr(func, "__name__", "")
        if name not in _OF_SIZE and name not in _OF_TENSORS and name != _NORMAL:
            return func(*args, **kwargs)
        if len(self._states) == 1:
            result = func(*args, **kwargs)
        elif name in _OF_SIZE or (name == _NORMAL and "size" in kwargs):
            result = self._of_size(func, list(args), kwargs)
        else:
            result = self._of_tensors(func, args, kwargs)
        self.made.append((name, len(result) if result.ndim else 0))
        return result

    def _of_size(self, func: Callable[..., Any], args: list[Any], kwargs: dict[str, Any]) -> torch.Tensor:
        if "size" in kwargs:
            size = tuple(kwargs.pop("size"))
        else:
            size = tuple(args[0]) if isinstance(args[0], Sequence) else tuple(args)
            args = []
        size = (self._rows(func, size[0] if size else 0), *size[1:])
        return torch.cat([self._drawn(i, func, args, {**kwargs, "size": size}) for i in range(len(self._states))])

    def _of_tensors(self, func: Callable[..., Any], args: Sequence[Any], kwargs: dict[str, Any]) -> torch.Tensor:
        def part(value: Any, i: int) -> Any:
            if not isinstance(value, torch.Tensor):
                return value
            rows = self._rows(func, len(value) if value.ndim else 0)
            return value[i * rows : (i + 1) * rows]

        parts = [
            self._drawn(i, func, [part(each, i) for each in args], {key: part(each, i) for key, each in kwargs.items()})
            for i in range(len(self._states))
        ]
        return args[0] if func.__name__.endswith("_") else torch.cat(parts)

    def _rows(self, func: Callable[..., Any], length: int) -> int:
        """Number of rows per request, out of `length`."""
        name, rows = self._alone[len(self.made)] if len(self.made) < len(self._alone) else ("", 0)
        if name != func.__name__ or rows == 0 or length != rows * len(self._states):
            raise NotByRequest(f"{func.__name__} of {length} rows for {counted(len(self._states), 'request')}")
        return rows

    def _drawn(self, i: int, func: Callable[..., Any], args: Sequence[Any], kwargs: Mapping[str, Any]) -> torch.Tensor:
        """The result of a random function with the generator of request `i`, whose state advances."""
        outside = self._state()
        self._set(self._states[i])
        result: torch.Tensor = func(*args, **kwargs)
        self._states[i] = self._state()
        self._set(outside)
        return result

    def _state(self) -> list[torch.Tensor]:
        return [each.get_rng_state() for each in self._generators]

    def _set(self, states: Sequence[torch.Tensor]) -> None:
        for each, state in zip(self._generators, states, strict=True):
            each.set_rng_state(state)
