"""The client that talks, as the how-to has it, with sentences and a model that are given."""

from __future__ import annotations

import re
from importlib.util import module_from_spec, spec_from_file_location
from pathlib import Path
from typing import Any

import pytest
from mcp import Client

from .conftest import Rig

PAGE = Path(__file__).parents[3] / "docs" / "how-to" / "talk-to-a-robot.md"


def talker(folder: Path) -> Any:
    (code, *_) = re.findall(r"^```python\n(.*?)^```", PAGE.read_text(encoding="utf-8"), re.MULTILINE | re.DOTALL)
    (folder / "talk.py").write_text(code, encoding="utf-8")
    spec = spec_from_file_location("talk", folder / "talk.py")
    assert spec is not None
    assert spec.loader is not None
    module = module_from_spec(spec)
    spec.loader.exec_module(module)
    return module.talk


@pytest.mark.parametrize("granted", [True, False], ids=["granted", "not granted"])
def test_what_is_heard_is_done_within_what_is_granted(rig: Rig, granted: bool, tmp_path: Path) -> None:
    sentences = iter(["Where is it?", "Move there and back.", "Stop!", ""])
    calls: dict[str, list[tuple[str, Any]]] = {
        "Where is it?": [("test_state", {})],
        "Move there and back.": [("test_move", {"to": 0.5}), ("test_move", {"to": -0.5})],
        "Stop!": [("stop", {})],
    }
    said: list[str] = []

    def think(sentence: str, tools: Any) -> list[tuple[str, Any]]:
        assert {"test_state", "test_move", "stop"} <= {each.name for each in tools}
        return calls[sentence]

    async def act(client: Client) -> None:
        await client.list_tools()
        if granted:
            rig.grant()
        await talker(tmp_path)(client, lambda: next(sentences), think, said.append)

    rig.talk(act)
    moved = [0.5, -0.5] if granted else []
    assert [each for each in rig.moves if isinstance(each, float)] == moved
    assert "stop" in rig.moves
    assert '"answer": 0.5' in said[0]
    assert said[1].startswith("That is not possible: /test/move") is not granted
    assert len(said) == (4 if granted else 3), "after a refusal, the rest of a sentence is left out"
