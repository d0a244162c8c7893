"""Accessibility of every view and dialog in both themes, by axe-core.

    npm pack axe-core && tar xzf axe-core-*.tgz
    python plugins/ibrobot-plugin-web/tests/axe.py package/axe.min.js

Prints what is serious or critical, and exits with 1 if there is any. It needs Chromium and playwright.
"""

from __future__ import annotations

import shutil
import sys
import tempfile
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).parents[3] / "tests/shared"))

FLAGS = ["--no-sandbox", "--use-gl=angle", "--use-angle=gl-egl", "--ignore-gpu-blocklist"]
SIZES = {"desktop": (1440, 900), "phone": (390, 844)}
TABS = ("Drive", "Episodes", "Plots", "Health", "Log")


def found(page: Any, where: str) -> int:
    """Print the findings of a view; return their number."""
    result = page.evaluate("axe.run(document, {resultTypes: ['violations']})")
    serious = [each for each in result["violations"] if each["impact"] in ("serious", "critical")]
    for each in serious:
        targets = ", ".join(str(node["target"][0]) for node in each["nodes"][:4])
        print(f"{where}: {each['impact']}: {each['id']}: {each['help']}: {targets}")
    print(f"{where}: {len(serious)} serious or critical, {len(result['violations'])} in all", flush=True)
    return len(serious)


def check_ui(chromium: Any, axe: str, address: str) -> int:
    """Check all views of `ibrobot ui`, with a robot YAML with problems and with a dialog; return the findings."""
    wrong = 0
    for theme in ("light", "dark"):
        for name, (width, height) in SIZES.items():
            viewport = {"width": width, "height": height}
            context = chromium.new_context(viewport=viewport, color_scheme=theme, bypass_csp=True)
            page = context.new_page()
            page.goto(address)
            page.wait_for_timeout(1500)
            page.add_script_tag(content=axe)
            for view in page.evaluate("ibrobot.session.views.map(({name}) => name)"):
                page.evaluate(f"location.hash = '{view}'")
                page.wait_for_timeout(1500)
                wrong += found(page, f"{theme} {name} ui {view}")
            page.evaluate("location.hash = 'robots'")
            page.get_by_label("Robot", exact=True).select_option("wrong.yaml")
            page.wait_for_timeout(1500)
            wrong += found(page, f"{theme} {name} ui problems")
            page.evaluate("void ibrobot.confirm('Delete?', 'Two episodes.', 'Delete')")
            wrong += found(page, f"{theme} {name} ui dialog")
            context.close()
    return wrong


def check_views_of_ui(chromium: Any, axe: str) -> int:
    """Start `ibrobot ui` in a folder with a good and a wrong robot YAML, and check its views."""
    from ui_path import own_robot, ui_process

    with tempfile.TemporaryDirectory() as folder:
        own_robot(Path(folder))
        (Path(folder) / "wrong.yaml").write_text("robot:\n  name: wrong\n", encoding="utf-8")
        with ui_process(Path(folder)) as address:
            return check_ui(chromium, axe, address)


def main() -> None:
    """Check all views."""
    from page_run import page_run
    from playwright.sync_api import sync_playwright

    axe = Path(sys.argv[1]).read_text(encoding="utf-8")
    with sync_playwright() as playwright:
        chromium = playwright.chromium.launch(executable_path=shutil.which("chromium"), args=FLAGS)
        wrong = check_views_of_ui(chromium, axe)
        chromium.close()
    with page_run("so101", "--sim", "--mode", "web") as address, sync_playwright() as playwright:
        chromium = playwright.chromium.launch(executable_path=shutil.which("chromium"), args=FLAGS)
        for theme in ("light", "dark"):
            for name, (width, height) in SIZES.items():
                context = chromium.new_context(
                    viewport={"width": width, "height": height}, color_scheme=theme, bypass_csp=True
                )
                page = context.new_page()
                page.goto(address)
                page.wait_for_timeout(4000)
                page.add_script_tag(content=axe)
                for tab in TABS:
                    page.get_by_role("tab", name=tab).click()
                    page.wait_for_timeout(700)
                    wrong += found(page, f"{theme} {name} {tab}")
                page.get_by_role("tab", name="Drive").click()
                page.get_by_role("button", name="End the run").click()
                wrong += found(page, f"{theme} {name} dialog")
                page.get_by_role("button", name="Keep it running").click()
                page.keyboard.press("Space")
                page.wait_for_timeout(1500)
                wrong += found(page, f"{theme} {name} fault")
                page.get_by_role("button", name="Reset").first.click()
                page.wait_for_timeout(700)
                context.close()
        chromium.close()
    sys.exit(1 if wrong else 0)


if __name__ == "__main__":
    main()
