"""The engine `monolithic`: the model in this process."""

from __future__ import annotations

from typing import override

from ibrobot_core.interfaces import Engine, Policy, Tensors


class LocalEngine(Engine):
    """Calls the policy directly; the policy's owner resets and closes it."""

    def __init__(self, policy: Policy) -> None:
        super().__init__("monolithic")
        self._policy = policy

    @override
    def start(self) -> None:
        self._policy.load()
        self._identify()
        self.stats.alive = True

    @override
    def run(self, tensors: Tensors, request_id: int, deadline_ns: int) -> Tensors:
        outputs = self._policy.infer(tensors)
        self._identify()  # a policy on a server may have connected to another one
        return outputs

    def _identify(self) -> None:
        self.stats.weights, self.stats.server = self._policy.weights(), self._policy.identity()
