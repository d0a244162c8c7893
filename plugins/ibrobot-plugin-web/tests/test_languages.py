"""The pages in other languages: tables that fit the code, and no English sentence left on the page of `ibrobot ui`."""

from __future__ import annotations

import ast
import json
import re
import shutil
from collections.abc import Iterator
from pathlib import Path

import pytest
from ibrobot_web.server.app import STATIC

CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser")
TABLES = sorted((STATIC / "words").glob("*.js"))
ENTRY = re.compile(r'^  ("(?:[^"\\]|\\.)*"): ("(?:[^"\\]|\\.)*"),$', re.MULTILINE)


def entries(table: Path) -> list[tuple[str, str]]:
    text = table.read_text(encoding="utf-8")
    found = [(json.loads(key), json.loads(value)) for key, value in ENTRY.findall(text)]
    assert len(found) == sum(line.startswith('  "') for line in text.splitlines()), "each line is an entry"
    return found


@pytest.mark.parametrize("table", TABLES, ids=lambda path: path.stem)
def test_a_table_fits_the_code(table: Path) -> None:
    sources = [*STATIC.rglob("*.js"), *STATIC.glob("*.html"), *STATIC.parent.rglob("*.py")]
    sources += (STATIC.parents[3]).glob("plugins/ibrobot-plugin-*/ibrobot_*/**/*.py")
    sources += STATIC.parents[3].glob("configs/*.yaml")
    code = "\n".join(path.read_text(encoding="utf-8") for path in sources if path.parent.name != "words").casefold()
    known = entries(table)
    assert len(known) > 300
    assert len(dict(known)) == len(known), "no text is there twice"
    for text, words in known:
        assert words.count("{}") == text.count("{}"), text
        for part in text.split("{}"):
            for word in re.findall(r"[^\W\d_]{4,}", part):
                assert word.casefold() in code, f"{text!r} is no longer in the code"


def assigned(node: ast.Assign) -> Iterator[tuple[str, ast.expr]]:
    """Each name with what it is given."""
    target, value = node.targets[0], node.value
    if isinstance(target, ast.Tuple) and isinstance(value, ast.Tuple):
        yield from zip(map(ast.unparse, target.elts), value.elts, strict=True)
    else:
        yield ast.unparse(target), value


CAUSES = sorted((STATIC.parents[3] / "plugins/ibrobot-plugin-diagnose/ibrobot_diagnose/causes").glob("[!_]*.py"))


@pytest.mark.skipif(not CAUSES, reason="needs the source of ibrobot-plugin-diagnose")
@pytest.mark.parametrize("table", TABLES, ids=lambda path: path.stem)
def test_each_cause_of_a_failure_has_its_remedy_in_the_table(table: Path) -> None:
    said = [
        text.value
        for path in CAUSES
        for each in ast.walk(ast.parse(path.read_text(encoding="utf-8")))
        if isinstance(each, ast.Assign)
        for name, text in assigned(each)
        if name in ("title", "remedy", "for_episodes") and isinstance(text, ast.Constant)
    ]
    assert len(said) > 120
    known = dict(entries(table))
    assert [text for text in said if text not in known] == []


WEB = STATIC.parent


def refusals() -> Iterator[str]:
    """What a run refuses to the page, as templates of the table."""
    for path in (WEB / "commands.py", WEB / "server/drive.py", WEB / "teleop.py"):
        for each in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            match each:
                case ast.Raise(exc=ast.Call(func=ast.Name(id="IbrobotError" | "CommandRefused"), args=[said])):
                    parts = said.values if isinstance(said, ast.JoinedStr) else [said]
                    yield "".join(str(part.value) if isinstance(part, ast.Constant) else "{}" for part in parts)


@pytest.mark.parametrize("table", TABLES, ids=lambda path: path.stem)
def test_what_a_run_refuses_is_in_the_table(table: Path) -> None:
    said = list(refusals())
    assert len(said) > 6
    known = dict(entries(table))
    assert [text for text in said if text not in known] == []


SHOWN = """[...document.querySelectorAll('#nav, #main')].flatMap((part) => {
  const walk = document.createTreeWalker(part, NodeFilter.SHOW_TEXT), found = [];
  while (walk.nextNode()) {
    const up = walk.currentNode.parentElement;
    if (up.checkVisibility() && !up.closest("code, pre, td")) found.push(walk.currentNode.data);
  }
  return found;
})"""
"""The visible texts of the page of `ibrobot ui`, without output, code and values."""

TITLE = """async (title) => {
  const { JobCard } = await import("/static/ui/job.js");
  const card = new JobCard({ session: { views: [] }, drives: true });
  card.update({ number: 1, title, kind: "convert", state: "done", facts: {}, lines: [] });
  return card.title.textContent;
}"""
"""What the card of a job with a title shows as its title."""

REPORTED = """async ([title, fix]) => {
  const { View } = await import("/static/ui/reports.js");
  const view = new View({ drives: true }, { name: "report-check", title: "Checks", report: "check" });
  view.mount(document.createElement("div"));
  view.sections = [{ title: "demos", blocks: [] }, { title, blocks: [] }];
  view.draw();
  const [button] = view.fixes({ title: "1. a", episode: "a", fixes: [fix] });
  return [view.body.querySelector("h3").textContent, button.textContent, button.ariaLabel];
}"""
"""What a report shows as a heading, and a button that mends an episode with what it is called."""

LATER = """async () => {
  const { words } = await import("/static/words.js");
  for (let i = 0; i < 5000; i += 1) words(`${i / 100} rad`);
  return words("Datasets");
}"""
"""A text of the table after many others were looked up, as on the page of a run."""


RUN = {
    "1 of 1 episode": ["个回合"],
    "you operate · 2 pages": ["由你操作", "个页面"],
    "watching · page 1 (127.0.0.1) operates · 2 pages": ["观看中", "页面 1", "2 个页面"],
    "emergency stop. The robot holds. Remove the cause, then reset.": ["急停", "机器人保持不动", "排除原因后复位"],
    "the connection is too slow to jog (0.2 s): released; press again": ["连接太慢", "0.2 秒", "请重新按下"],
}
"""Texts of the page of a run, with what they say in Chinese; entries are for all numbers."""
SAID = """async (text) => (await import("/static/words.js")).words(text)"""


@pytest.mark.integration
@pytest.mark.skipif(CHROMIUM is None, reason="needs Chromium: apt-get install chromium")
def test_no_english_sentence_is_left_in_a_chinese_browser(tmp_path: Path) -> None:
    sync_api = pytest.importorskip("playwright.sync_api", reason="needs playwright: pip install playwright")
    from ui_path import FLAGS, SMALL, own_robot, ui_process, until

    own_robot(tmp_path)
    with ui_process(tmp_path) as address, sync_api.sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=CHROMIUM, args=FLAGS)
        page = browser.new_page(locale="zh-CN", **SMALL)
        errors: list[str] = []
        page.on("pageerror", lambda error: errors.append(str(error)))
        page.goto(address)
        page.get_by_text("没有发现问题。").wait_for(timeout=60_000)
        assert page.evaluate("document.documentElement.lang") == "zh"
        assert page.get_by_role("link", name="数据集", exact=True).is_visible()
        for view in page.evaluate("ibrobot.session.views.map(({name}) => name)"):
            page.evaluate(f"location.hash = {view!r}")
            until(page, f"document.querySelector('#view-{view.replace(' ', '-')}')?.isConnected")
            page.wait_for_timeout(500)
            if view == "devices":
                page.locator(".guides form code").first.wait_for()
            if view == "job-train":
                continue  # what is missing for it, in the words of its package
            english = re.compile(r"[^\u4e00-\u9fff]*[A-Za-z]+ [a-z]+ [a-z]+[^\u4e00-\u9fff]*")
            texts = page.evaluate(SHOWN)
            assert [text for text in texts if english.fullmatch(text)] == [], view
            assert [text for text in texts if "`" in text] == [], f"{view}: code is shown as code"
        for title, shown in (
            ("Convert picks/a", "转换 picks/a"),
            ("Explain b", "分析失败 b"),
        ):
            assert page.evaluate(TITLE, title) == shown
        second = "2. The guard held the arm back in 55 % of the run, mostly between gripper and table."
        heading, button, called = page.evaluate(REPORTED, [second, {"label": "Drop", "does": "delete"}])
        assert heading.startswith("2. 防碰保护在 55 % 的运行时间里")
        assert called == f"{button}: 1. a", "a person who speaks what stands on the button finds it"
        assert page.evaluate(LATER) == "数据集"
        for text, parts in RUN.items():
            shown = page.evaluate(SAID, text)
            assert [part for part in parts if part not in shown] == [], shown
            assert re.search("[A-Za-z]{4}", shown) is None, shown
        browser.close()
    assert errors == []
