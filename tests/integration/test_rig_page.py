"""A rig on the page: a reference is taken and compared, a moved camera is shown beside it and put back; boards."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import pytest

CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser")
pytestmark = [
    pytest.mark.integration,
    pytest.mark.skipif(CHROMIUM is None, reason="needs Chromium: apt-get install chromium"),
    pytest.mark.usefixtures("rendering"),
]
_SCENE = "  scene: pick_cube\n"
_SLOW = """
const usual = window.fetch;
window.fetch = async (address, ...rest) => {
  if (String(address).includes("devices/state")) await new Promise((answer) => setTimeout(answer, 500));
  return usual(address, ...rest);
};
"""
"""Each look at the steps of a guide takes so long that a click begins the next one meanwhile: none shows twice."""
_TURNED = "  scene: {type: pick_cube, camera_turn: [0.012, 0.012]}\n"


def test_a_moved_camera_is_found_and_put_back(tmp_path: Path) -> None:
    sync_api = pytest.importorskip("playwright.sync_api", reason="needs playwright: pip install playwright")
    from ui_path import FLAGS, own_robot, ui_process, until

    own_robot(tmp_path)
    usual = (tmp_path / "my_arm.yaml").read_text(encoding="utf-8")
    assert _SCENE in usual
    (tmp_path / "moved.yaml").write_text(usual.replace(_SCENE, _TURNED), encoding="utf-8")
    errors: list[str] = []
    with ui_process(tmp_path) as address, sync_api.sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=CHROMIUM, args=FLAGS)
        page = browser.new_page(device_scale_factor=0.5)
        page.context.set_default_timeout(120_000)
        page.add_init_script(_SLOW)
        page.on("pageerror", lambda error: errors.append(str(error)))
        page.goto(address)
        page.get_by_role("link", name="Preflight", exact=True).click()
        page.get_by_label("Simulated").check()

        def preflight(robot: str, against: str, take: str, ends: str) -> str:
            for field, value in (("Robot", robot), ("Against", against), ("Take", take)):
                page.get_by_label(field, exact=True).fill(value)
            page.get_by_role("button", name="Preflight", exact=True).press("Enter")
            card = page.locator(".job").filter(has_text=f"Preflight {robot}, {against or take}")
            card.locator(f".state.{ends}").wait_for()
            return str(card.inner_text())

        assert "reference -> rig.json" in preflight("my_arm.yaml", "", "rig.json", "done")
        said = preflight("moved.yaml", "rig.json", "", "failed")
        assert "The camera top has moved: its picture is shifted by " in said
        assert "warns from 3, fails from 5]" in said
        assert "What to do: Put the camera back" in said
        assert "exit code" not in said
        page.get_by_role("link", name="Open in Preflights").first.press("Enter")
        for title in ("top now", "top in the reference"):
            picture = page.get_by_role("img", name=title)
            picture.wait_for()
            until(page, f"document.querySelector('img[alt=\"{title}\"]').naturalWidth > 0")

        # The picture of then lies over the live one, with where to turn the camera.
        page.get_by_role("link", name="Devices", exact=True).press("Enter")
        for field, value in (("robot", "moved.yaml"), ("against", "rig.json"), ("camera", "top")):
            page.locator(f"#refit-{field}").fill(value)
        page.locator("#refit-simulated").check()
        page.get_by_role("button", name="Put a camera back: start").press("Enter")
        page.locator(".ask td", has_text="turn it right and up").wait_for()
        until(page, "document.querySelector('.ask img.sight').naturalWidth > 0")
        page.get_by_role("button", name="Done", exact=True).press("Enter")
        page.locator(".steps").get_by_text("The camera top has moved").wait_for()
        page.locator(".card .state.done").wait_for()
        assert page.evaluate("document.activeElement !== document.body"), "the focus is not lost"

        page.get_by_role("button", name="Make a board to print: start").press("Enter")
        page.locator(".steps").get_by_text("board.pdf is written.").wait_for()
        assert (tmp_path / "board.pdf").read_bytes().startswith(b"%PDF")
        browser.close()
    assert json.loads((tmp_path / "preflights/moved/preflight.json").read_text())["verdict"] == "fail"
    assert errors == []
