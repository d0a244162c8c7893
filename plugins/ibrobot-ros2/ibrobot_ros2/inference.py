"""IB-Robot's action `DispatchInfer`: the next chunk of the model that acts.

A run has one dispatcher, which asks the model; it is asked nothing more for others. Who sends a goal gets the answer to
the dispatcher's next request.
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Mapping
from typing import Any

import attrs

from ibrobot_core.api import MODEL_ANSWERS, ModelAnswer, NotSupported, PolicyError, documented, option
from ibrobot_core.app import RunView, Service

_GLANCE_S = 0.1
_DEPTH = 16


@documented
@attrs.frozen
class InferRequest:
    """A request to `/act_inference_node/DispatchInfer`."""

    obs_timestamp_ns: int = option(0, unit="ns", help="the observations are of this time or a later one")
    prompt: str = option("", help="the task; empty, or that of the mode")
    inference_id: str = option("", help="not used")


@documented
@attrs.frozen
class InferResult:
    """A chunk of actions."""

    action_chunk: Mapping[str, Any] = option(
        help="as ibrobot_msgs/msg/VariantsList: `action`, shape (N, J) [rad], for the joints of the contract"
    )
    chunk_size: int = option(help="the number N of actions")
    success: bool = option(help="whether there is a chunk")
    message: str = option(help="the model, the time of its observations [ns], and the joints")
    inference_latency_ms: float = option(unit="ms", help="time from the observations to the answer")


DISPATCH_INFER = Service(
    "/act_inference_node/DispatchInfer", InferRequest, InferResult,
    "Wait for the next chunk of the model that acts; nothing more is asked of it, and nothing moves by it.",
    ros_type="ibrobot_msgs/action/DispatchInfer", reads=True,
)  # fmt: skip


def serve_chunks(session: RunView) -> Callable[[], None]:
    """Serve `DispatchInfer` for those who speak ROS, unless another does; returns what ends it."""
    if session.bus.serves(DISPATCH_INFER):
        return lambda: None
    ended = threading.Event()
    session.bus.serve(DISPATCH_INFER, lambda request: _next_chunk(session, request, ended))

    def end() -> None:
        ended.set()
        session.bus.unserve(DISPATCH_INFER)

    return end


def _next_chunk(session: RunView, request: InferRequest, ended: threading.Event) -> InferResult:
    """The next chunk.

    Raises:
        NotSupported: if no model acts, or it has another prompt.
        PolicyError: if the model fails, or the mode ends.
    """
    acting = session.acting
    if acting is None:
        raise NotSupported(f"no model acts in mode {session.mode}")
    answers = session.bus.subscribe(MODEL_ANSWERS, _DEPTH)
    try:
        while session.acting is acting and not ended.is_set():
            received = answers.get(_GLANCE_S)
            answer = received.message if received is not None else None
            if isinstance(answer, ModelAnswer) and answer.observed_ns >= request.obs_timestamp_ns:
                return _result(answer, request)
    finally:
        answers.close()
    raise PolicyError("the mode or the run ended before there was a chunk")


def _result(answer: ModelAnswer, request: InferRequest) -> InferResult:
    if request.prompt not in ("", answer.prompt):
        raise NotSupported(f"the model has the prompt {answer.prompt!r}; a goal cannot change it to {request.prompt!r}")
    if not answer.actions.size:
        raise PolicyError(answer.error or f"the answer of {answer.model} was no chunk")
    count = answer.actions.size // len(answer.joint_names)
    sizes = [{"size": count}, {"size": len(answer.joint_names)}]
    data = {"layout": {"dim": sizes}, "data": answer.actions}
    message = f"{answer.model}, observed at {answer.observed_ns}, {', '.join(answer.joint_names)}"
    chunk = {"variants": [{"key": "action", "type": "float_64_array", "float_64_array": data}]}
    return InferResult(chunk, count, True, message, answer.latency_ms)
