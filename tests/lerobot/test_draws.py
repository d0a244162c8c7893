"""Random numbers of a batch are those that each request draws alone, bit for bit."""

from __future__ import annotations

from collections.abc import Callable

import pytest
import torch
from ibrobot_lerobot.draws import Draws, NotByRequest

pytestmark = pytest.mark.lerobot

CPU = torch.device("cpu")
SEEDS = (3, 1, 4, 1)
PROBABILITIES = torch.tensor([[0.1, 0.2, 0.3, 0.4], [0.4, 0.3, 0.2, 0.1]])


def probabilities(n: int) -> torch.Tensor:
    """Two rows for each of `n` requests."""
    return PROBABILITIES.repeat(n, 1)


WAYS: dict[str, Callable[[int], torch.Tensor]] = {
    "randn": lambda n: torch.randn(n, 5, 7),
    "randn_of_a_tuple": lambda n: torch.randn((n, 3)),
    "randn_by_name": lambda n: torch.randn(size=(2 * n, 40), dtype=torch.float64, device=CPU),
    "rand": lambda n: torch.rand([n, 3]),
    "normal": lambda n: torch.normal(mean=0.5, std=2.0, size=(n, 20), dtype=torch.float32),
    "normal_of_tensors": lambda n: torch.normal(torch.zeros(n, 20), torch.ones(n, 20)),
    "randn_like": lambda n: torch.randn_like(torch.zeros(n, 20)),
    "rand_like": lambda n: torch.rand_like(torch.zeros(n, 20)),
    "multinomial": lambda n: torch.multinomial(probabilities(n), num_samples=1),
    "bernoulli": lambda n: torch.bernoulli(probabilities(n)),
    "normal_": lambda n: torch.zeros(n, 20).normal_(),
    "uniform_": lambda n: torch.zeros(n, 20).uniform_(-1, 1),
    "bernoulli_": lambda n: torch.zeros(n, 20).bernoulli_(0.5),
    "one_after_the_other": lambda n: torch.randn(n, 3) + torch.rand(n, 3) * torch.randn(n, 3),
}


@pytest.mark.parametrize("way", WAYS)
def test_a_batch_draws_what_each_request_draws_alone(way: str) -> None:
    draw = WAYS[way]
    alone, made = [], []
    for seed in SEEDS:
        with torch.random.fork_rng([]), Draws([seed], CPU) as draws:
            alone.append(draw(1))
        made = draws.made
        torch.manual_seed(seed)
        assert torch.equal(alone[-1], draw(1)), "a request alone draws as without us"
    with torch.random.fork_rng([]), Draws(SEEDS, CPU, made) as draws:
        together = draw(len(SEEDS))
        assert not draws.escaped
    assert torch.equal(together, torch.cat(alone))


def test_other_draws_are_noticed() -> None:
    with torch.random.fork_rng([]), Draws(SEEDS, CPU, []) as draws:
        torch.randperm(4)
        assert draws.escaped


@pytest.mark.parametrize("made", [[], [("rand", 1)], [("randn", 2)]])
def test_draws_that_are_not_each_requests_are_refused(made: list[tuple[str, int]]) -> None:
    with torch.random.fork_rng([]), pytest.raises(NotByRequest), Draws(SEEDS, CPU, made):
        torch.randn(4, 3)
