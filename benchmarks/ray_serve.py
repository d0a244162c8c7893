"""Ray Serve with a model that does nothing, for `inference_transport.py`, which runs this file.

It runs where `ray[serve]==2.60.*` is installed: a cluster of this machine and one deployment that answers each request
with a chunk's bytes, asked over HTTP through Ray Serve's proxy on one connection, and by a handle, as a program on the
cluster asks. Bodies have the bytes of the observations of `inference_transport.py`.
"""

from __future__ import annotations

import argparse
import http.client
import json
import logging
import time
from collections.abc import Callable
from typing import Any

import ray
from ray import serve

PAYLOADS = {"2x640x480 uint8": 2 * 640 * 480 * 3, "2x224x224 float32": 2 * 3 * 224 * 224 * 4, "2 JPEGs": 2 * 38_400}
"""Bytes of the pictures; joint positions and names add 200."""
CHUNK_BYTES = 1280
WARM_UP = 20


@serve.deployment(ray_actor_options={"num_cpus": 0})
class Null:
    """Answers with zeros."""

    async def __call__(self, request: Any) -> bytes:
        """Over HTTP: `request` is Starlette's."""
        await request.body()
        return bytes(CHUNK_BYTES)

    async def answer(self, body: bytes) -> bytes:
        """By a handle."""
        return bytes(CHUNK_BYTES)


def measure(ask: Callable[[], bytes], count: int, pause_s: float) -> dict[str, Any]:
    """Latencies [ms]; processor time is spread over the processes of Ray, and not measured."""
    latencies = []
    for _ in range(count + WARM_UP):
        time.sleep(pause_s)
        asked_s = time.perf_counter()
        if len(ask()) != CHUNK_BYTES:
            raise SystemExit("Ray Serve gave no chunk")
        latencies.append((time.perf_counter() - asked_s) * 1e3)
    return {"latencies": latencies[WARM_UP:], "blocked": latencies[WARM_UP:], "cpu_ms": float("nan")}


def main() -> None:
    """Print one JSON line for each payload and way."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--count", type=int, default=200)
    parser.add_argument("--pause", type=float, default=0.0)
    parser.add_argument("--port", type=int, default=50191)
    given = parser.parse_args()
    ray.init(num_cpus=2, include_dashboard=False, logging_level=logging.ERROR, log_to_driver=False)
    serve.start(http_options={"host": "127.0.0.1", "port": given.port}, logging_config={"log_level": "ERROR"})
    null: Any = Null  # a Deployment, which Ray's types do not say
    handle = serve.run(null.bind(), logging_config={"log_level": "ERROR"})
    connection = http.client.HTTPConnection("127.0.0.1", given.port)
    for payload, size in PAYLOADS.items():
        body = bytes(size + 200)

        def over_http(body: bytes = body) -> bytes:
            connection.request("POST", "/", body)
            return connection.getresponse().read()

        def by_handle(body: bytes = body) -> bytes:
            answer: bytes = handle.answer.remote(body).result()
            return answer

        for way, ask in (("ray HTTP", over_http), ("ray handle", by_handle)):
            print(json.dumps({"payload": payload, "way": way, **measure(ask, given.count, given.pause)}), flush=True)
    connection.close()
    serve.shutdown()
    ray.shutdown()


if __name__ == "__main__":
    main()
