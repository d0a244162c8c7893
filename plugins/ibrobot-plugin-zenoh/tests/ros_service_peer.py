"""A ROS 2 node of another make, on the router that is given: calls /ours, prints the answer, and serves /theirs."""

from __future__ import annotations

import sys
from typing import Any

from zenoh_ros2_sdk import ROS2ServiceClient, ROS2ServiceServer

port, digest = int(sys.argv[1]), sys.argv[2]
TYPE: dict[str, Any] = {
    "srv_type": "std_srvs/srv/SetBool",
    "request_definition": "bool data\n",
    "response_definition": "bool success\nstring message\n",
    "type_hash": digest,
    "domain_id": 0,
    "router_port": port,
}


def answer(request: Any) -> Any:
    """What it was asked."""
    return server.response_msg_class(success=request.data, message=f"heard {request.data}")


server = ROS2ServiceServer("/theirs", callback=answer, **TYPE)
client = ROS2ServiceClient("/ours", **TYPE)
response = None
while response is None:
    response = client.call(data=True)
print(response.success, response.message, flush=True)
sys.stdin.read()
