import base64
import csv
import json
import re
from fractions import Fraction
from html import escape
from xml.etree import ElementTree

import pytest
from ibrobot_eval.contents import contents_of, lines_of, read_contents
from ibrobot_eval.episodes import Result
from ibrobot_eval.film import encode
from ibrobot_eval.options import REPORT
from ibrobot_eval.page import as_page
from ibrobot_eval.report import Report, write_report
from ibrobot_provenance.reports import PLOT_CLASSES, Cases, Plots, Table, Text
from ibrobot_provenance.svg import Axis

from ibrobot_core.api import IbrobotError

from .made_results import policy, result

HOSTILE = '<script>alert("x")</script>'


def made(label="good", *, episodes=12):
    """A report on a policy that succeeds, and one that fails where the cube is far away."""
    found: dict[str, list[Result]] = {label: [], "bad": []}
    for seed in range(episodes):
        where = {"cube_x": 0.1 + seed / 100, "cube_y": 0.05 * (seed % 3), "light": 1.0 + seed % 5, "friction": 1.0}
        found[label].append(result(seed, True, factors=where))
        found["bad"].append(result(seed, seed < 3, factors=where, faults=("joint: <stuck>",) if seed == 5 else ()))
    return Report.of_simulation([policy(label), policy("bad")], found, 0.1, until_decided=False)


def test_json_has_each_episode_and_its_command():
    facts = made().facts()
    assert [each["successes"] for each in facts["policies"]] == [12, 3]
    assert facts["comparisons"][0]["words"] == "good is better than bad"
    last = facts["episodes"][-1]
    assert (last["policy"], last["seed"], last["success"]) == ("bad", 11, False)
    assert last["command"].startswith("ibrobot record robot.yaml --sim --lockstep --headless --mode bad --seed 11 ")
    assert last["recording"] == "episodes/bad/seed_000011"
    json.dumps(facts, allow_nan=False)


def test_csv_has_a_line_for_each_episode_with_its_factors():
    rows = list(csv.DictReader(made().as_csv().splitlines()))
    assert len(rows) == 24
    assert (rows[0]["policy"], rows[0]["success"]) == ("good", "1")
    assert float(rows[3]["cube_x"]) == pytest.approx(0.13)


def test_markdown_lists_failures_and_verdict():
    text = made().as_markdown()
    assert "**good is better than bad.**" in text
    assert "12 of 12" in text
    assert text.count("`ibrobot record") == 9


def test_page_is_one_file_without_network_and_well_formed(tmp_path):
    text = as_page(tmp_path, made())
    assert not re.search(r"(?:src|href)=\"(?!data:|episodes/)", text)
    assert "http" not in text.replace("http-equiv", "")
    for picture in re.findall(r"<svg.*?</svg>", text, re.DOTALL):
        ElementTree.fromstring(picture)
    assert text.count('class="failure"') == 9
    assert "good: outcomes over cube_x and cube_y" in text
    assert "bad: success rate over light" in text
    assert "over friction" not in text, "it never varies"


def test_wide_plots_are_scrolled_on_a_phone_since_smaller_texts_cannot_be_read(tmp_path):
    text = as_page(tmp_path, made())
    widths = re.findall(r"<svg [^>]*style=\"min-width:([0-9.]+)px;max-width:([0-9.]+)px\"", text)
    assert widths
    assert all(float(least) == pytest.approx(0.8 * float(most)) for least, most in widths)
    phone = 390 - 2 * 24
    within = re.findall(r'<div class="scroll" tabindex="0"><svg [^>]*min-width:([0-9.]+)px', text)
    assert len(within) == sum(float(least) > phone for least, _ in widths)


def test_page_escapes_names_and_faults(tmp_path):
    text = as_page(tmp_path, made(HOSTILE))
    assert HOSTILE not in text
    assert "<stuck>" not in text


def test_page_has_the_videos_of_the_folder(tmp_path):
    report = made()
    video = tmp_path / report.failures[0].video
    video.parent.mkdir(parents=True)
    video.write_bytes(b"a video")
    text = as_page(tmp_path, report)
    assert text.count("<video") == 1
    assert base64.b64encode(b"a video").decode() in text


LONG = f"ValueError: <{'x' * 300}>"


def with_errors():
    """A report on a policy with a success, a failure, an error with a recording and one without, and one of errors."""
    near, far = {"cube_x": 0.1}, {"cube_x": 0.2}
    mixed = [
        result(0, True, factors=near), result(1, False, factors=far),
        result(2, False, factors=near, error=LONG, acting={"weights": "1"}),
        result(3, False, factors=far, error="it hung"),
    ]  # fmt: skip
    broken = [result(seed, False, error="it hung") for seed in range(4)]
    return Report.of_simulation(
        [policy("mixed"), policy("no")], {"mixed": mixed, "no": broken}, 0.1, until_decided=False
    )


def test_errors_do_not_look_like_failures(tmp_path):
    report = with_errors()
    found = {each.title: each.blocks for each in contents_of(tmp_path, report)}
    errors, failures = (
        [case for block in found[title] if isinstance(block, Cases) for case in block.cases]
        for title in ("Errors of policies (6)", "Failures (1)")
    )
    assert [each.title for each in failures] == ["mixed, seed 1"]
    assert [each.text for each in errors] == [LONG, *["it hung"] * 5]
    assert [each.episode is None for each in errors] == [False, *[True] * 5], "what hung has no recording"
    texts = [each.text for each in blocks(tmp_path, report, Text)]
    assert texts[0] == "no: all 4 episodes ended in an error, so this is no evaluation of it."
    assert "Episodes that ended in an error of the policy count as failures in the rates and comparisons." in texts
    strips, panel = (
        next(each for each in found[title] if isinstance(each, Plots)).pictures[0]
        for title in ("Episodes", "Where it succeeds and fails")
    )
    marks = re.findall(r"<rect[^>]*height=\"(\d+)\"[^>]*><title>seed \d: (success|failure|error)", strips)
    assert marks == [("13", "success"), ("22", "failure"), *[("7", "error")] * 6]
    page = as_page(tmp_path, report)
    assert 'href="."' not in page
    assert LONG not in page
    assert "1 of 1" in panel
    assert "1 of 2" not in panel, "an error has no place in it"


def test_markdown_lists_errors_apart_from_failures():
    head, errors, failures = with_errors().as_markdown().split("\n## ")
    assert "**no: all 4 episodes ended in an error, so this is no evaluation of it.**" in head
    assert (errors.count("`ibrobot record"), failures.count("`ibrobot record")) == (6, 1)


def test_report_without_errors_mentions_none(tmp_path):
    assert "error" not in as_page(tmp_path, made()).replace("episodes with errors", "")


def test_report_of_one_policy_compares_nothing(tmp_path):
    report = Report.of_simulation([policy("a")], {"a": [result(0, False)]}, 0.1, until_decided=False)
    assert report.comparisons == ()
    assert "Comparison" not in as_page(tmp_path, report)
    write_report(tmp_path, report)
    assert {each.name for each in tmp_path.iterdir()} == {"report.json", "report.csv", "report.md"}


def blocks(out, report, kind):
    return [each for section in contents_of(out, report) for each in section.blocks if isinstance(each, kind)]


def test_written_report_is_read_as_it_was(tmp_path):
    report = made(HOSTILE)
    write_report(tmp_path, report)
    assert Report.read(tmp_path / REPORT) == report
    assert read_contents(tmp_path) == contents_of(tmp_path, report)
    assert lines_of(tmp_path) == report.lines()


def test_file_shows_what_pages_show(tmp_path):
    report = made()
    page = as_page(tmp_path, report)
    pictures = [picture for plots in blocks(tmp_path, report, Plots) for picture in plots.pictures]
    assert re.findall(r"<svg.*?</svg>", page, re.DOTALL) == pictures
    assert len(pictures) == 1 + 1 + 2 + 2 + 2
    for text in blocks(tmp_path, report, Text):
        assert escape(text.text) in page
    assert page.count("<table>") == len(blocks(tmp_path, report, Table)) == 2
    (cases,) = blocks(tmp_path, report, Cases)
    assert [each.title for each in cases.cases] == [f"bad, seed {seed}" for seed in range(3, 12)]
    assert cases.cases[2].text == "joint: <stuck>"


def test_plots_have_only_classes_that_pages_colour(tmp_path):
    pictures = [picture for plots in blocks(tmp_path, made(), Plots) for picture in plots.pictures]
    assert {name for picture in pictures for name in re.findall(r'class="([^"]*)"', picture)} == set(PLOT_CLASSES)


def test_evaluation_without_a_report_can_be_continued(tmp_path):
    assert lines_of(tmp_path) == ["not finished; start the same evaluation again to continue"]
    with pytest.raises(IbrobotError, match="has no report yet"):
        read_contents(tmp_path)


@pytest.mark.parametrize("text", ["", "[]", "{}", '{"lines": 3}', '{"policies": [{"label": "a"}], "episodes": [1]}'])
def test_damaged_report_is_an_error_that_names_it(tmp_path, text):
    (tmp_path / REPORT).write_text(text)
    for read in (lines_of, read_contents):
        with pytest.raises(IbrobotError, match=r"report\.json: is not a report of an evaluation"):
            read(tmp_path)


def test_wrong_values_in_a_report_are_an_error_that_names_it(tmp_path):
    write_report(tmp_path, made())
    facts = json.loads((tmp_path / REPORT).read_text())
    facts["episodes"][0]["time_s"] = "soon"
    (tmp_path / REPORT).write_text(json.dumps(facts))
    with pytest.raises(IbrobotError, match=r"report\.json: is not a report of an evaluation"):
        read_contents(tmp_path)


@pytest.mark.parametrize("ends", [(0.0, 1.0), (-0.3, 0.31), (0.0, 480.0), (2.0, 2.0)])
def test_ticks_are_round_and_within_the_axis(ends):
    low, high = ends
    ticks = Axis(low, high, 0, 100).ticks()
    assert 1 <= len(ticks) <= 7
    assert all(ends[0] - 1e-9 <= tick <= ends[1] + 1e-9 for tick in ticks)


def test_video_of_pictures_can_be_decoded_and_is_repeatable():
    import io

    import av
    import numpy as np

    encoder = av.CodecContext.create("mjpeg", "w")
    encoder.width, encoder.height, encoder.pix_fmt, encoder.time_base = 64, 48, "yuvj420p", Fraction(1, 10)
    pictures = []
    for shade in range(0, 250, 25):
        frame = av.VideoFrame.from_ndarray(np.full((48, 64, 3), shade, np.uint8), "rgb24").reformat(format="yuvj420p")
        pictures += [bytes(packet) for packet in encoder.encode(frame)]
    video = encode(pictures, 10.0)
    assert video == encode(pictures, 10.0)
    with av.open(io.BytesIO(video), "r") as container:
        frames = list(container.decode(video=0))
    assert {frame.format.name for frame in frames} == {"yuvj420p"}, "of the full range, as JPEG pictures"
    shades = [frame.to_ndarray(format="rgb24").mean() for frame in frames]
    assert (len(shades), shades) == (10, sorted(shades))
    assert shades[0] < 20
    assert shades[-1] > 200
