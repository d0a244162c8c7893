"""An agent in a process of its own, by HTTP: `http_agent.py URL TOKEN HOST`, with calls as lines of JSON on its input.

It lists the tools, prints `ready`, and carries out a list of calls from each line. Meanwhile it gives signs of life.
"""

from __future__ import annotations

import asyncio
import json
import sys

import httpx2
from mcp import Client
from mcp.client.streamable_http import streamable_http_client

_BEAT_S = 0.25


async def main() -> None:
    """Call what the input says."""
    url, token, host = sys.argv[1:]
    headers = {"Authorization": f"Bearer {token}", "Host": host}
    async with (
        httpx2.AsyncClient(headers=headers, timeout=60) as http,
        Client(streamable_http_client(url, http_client=http)) as client,
    ):
        await client.list_tools()
        print("ready", flush=True)

        async def beat() -> None:
            while True:
                await client.call_tool("authority", {})
                await asyncio.sleep(_BEAT_S)

        beats = asyncio.create_task(beat())
        while line := await asyncio.to_thread(sys.stdin.readline):
            for name, arguments in json.loads(line):
                result = await client.call_tool(name, arguments)
                if result.is_error:
                    print(f"refused: {name}: {result.content}", file=sys.stderr, flush=True)
        beats.cancel()


if __name__ == "__main__":
    asyncio.run(main())
