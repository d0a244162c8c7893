"""Causes in time: late observations, slow answers, a plan that runs dry, missed ticks, another rate."""

from __future__ import annotations

from typing import override

import numpy as np
from ibrobot_terminal.plural import counted

from ibrobot_core.api import NS_PER_S
from ibrobot_diagnose.card import Card
from ibrobot_diagnose.cause import CardCause, Cause, Evidence, Reference, likelihood
from ibrobot_diagnose.course import course_of
from ibrobot_diagnose.window import Asked, Floats, Times, Window


def _of(part: int, whole: int, what: str) -> str:
    return f"{part} of {whole} {what}"


def _age_ms(stamps: Times, received: Times, t_ns: Times) -> Floats:
    """Age [ms] of the newest sample at each time; times before the first sample are left out."""
    index = np.searchsorted(received, t_ns, side="right") - 1
    there = index >= 0
    result: Floats = (t_ns[there] - stamps[index[there]]) / 1e6
    return result


class ObservationLate(Cause):
    """Observations are old when the model sees them."""

    name = "observation_late"
    title = "observations are fresh when the model sees them"
    needs = frozenset({"answers"})
    remedy = (
        "Make this stream faster: for a camera choose MJPG, a lower resolution, a USB port of its own or a shorter "
        "buffer; for joints look at the bus and at `ibrobot doctor`. A policy can also be trained on observations as "
        "late as these."
    )

    @override
    def test(self, window: Window, reference: Reference) -> Evidence | None:
        t_ns = np.array([each.answer.observed_ns for each in window.asked], np.int64)
        streams = {"joint positions": (window.state.stamps_ns, window.state.times_ns, 60.0)}
        for camera in window.cameras.values():
            stamps, received = np.array(camera.stamps_ns, np.int64), np.array(camera.times_ns, np.int64)
            period_ms = float(np.median(np.diff(received))) / 1e6 if len(received) > 1 else 0.0
            streams[f"pictures of {camera.name}"] = (stamps, received, 90.0 + 1.5 * period_ms)
        worst: tuple[float, str, float, float] = (0.0, "", 0.0, 1.0)
        for what, (stamps, received, threshold) in streams.items():
            if len(received) < 2 or not len(t_ns):
                continue
            ages = _age_ms(stamps, received, t_ns)
            if not len(ages):
                continue
            usual = reference.card.ages_ms.get(what) if reference.card is not None else None
            limit = threshold if usual is None else max(threshold, usual + 60.0)
            age = float(np.median(ages))
            worst = max(worst, (age / limit, what, age, limit))
        _, what, age, limit = worst
        if not what:
            return None
        text = f"The {what} were {age:.0f} ms old when the model saw them; up to {limit:.0f} ms are usual."
        return Evidence(text, age, "ms", limit, likelihood(age, limit, 2.0 * limit))


class AnswersSlow(Cause):
    """Answers come when much of their chunk is past."""

    name = "answers_slow"
    title = "the model answers in time"
    needs = frozenset({"answers"})
    explains = frozenset({"plan_dry", "stands_still", "limits_low"})  # each chunk begins away from where the arm is
    remedy = (
        "Make the model faster (a GPU, fewer denoising steps, `ibrobot export --to onnx`, smaller pictures), or let it "
        "answer with longer chunks; `dispatch: {watermark: auto}` asks early enough if the plan is long enough."
    )

    @override
    def test(self, window: Window, reference: Reference) -> Evidence | None:
        used = [each for each in window.asked if len(each.chunk) and each.answer.outcome in ("used", "late")]
        if not used:
            return None
        shares = np.array([_past_share(each) for each in used])
        latencies = np.array([each.answer.latency_ms for each in used])
        share, latency = float(np.median(shares)), float(np.median(latencies))
        chunk_ms = float(np.median([len(each.chunk) * each.answer.step_ns / 1e6 for each in used]))
        late = sum(each.answer.outcome == "late" for each in used)
        if share < 1:
            what = f"{100 * share:.0f} % of each chunk, which lasts {chunk_ms:.0f} ms, is past when it comes"
        else:
            what = f"a chunk lasts {chunk_ms:.0f} ms, so that all of it is past when it comes"
        text = f"The model needed {latency:.0f} ms for an answer: {what}."
        details = [f"slowest answer: {latencies.max():.0f} ms"]
        if late:
            details.append(f"{_of(late, len(used), 'answers')} came after their whole chunk was past")
        return Evidence(text, 100 * share, "%", 35.0, likelihood(share, 0.35, 0.7), details=tuple(details))


def _past_share(each: Asked) -> float:
    return float(each.answer.latency_ms * 1e6 / max(1, len(each.chunk) * each.answer.step_ns))


class PlanDry(Cause):
    """The arm waits without a plan."""

    name = "plan_dry"
    title = "the plan never runs dry"
    needs = frozenset({"chunks", "commands", "state"})
    remedy = (
        "Ask for the next chunk earlier: `dispatch: {watermark: auto}`, or a larger number. If observations were "
        "missing meanwhile, `ibrobot episodes verify` names the stream that paused."
    )

    @override
    def test(self, window: Window, reference: Reference) -> Evidence | None:
        course = course_of(window)
        if course is None:
            return None
        waits = course.dry & ~course.operated
        share = float(waits.mean())
        if not waits.any():
            return None
        begins = int((waits & ~np.append(False, waits[:-1])).sum())
        seconds = waits.sum() / window.contract.rate_hz
        text = (
            f"The plan ran dry {begins} {'time' if begins == 1 else 'times'}: the arm held still for {seconds:.1f} s, "
            f"{100 * share:.0f} % of the run, since the next answer had not come."
        )
        since = window.since(int(course.times_ns[waits.argmax()]))
        return Evidence(text, 100 * share, "%", 4.0, likelihood(share, 0.04, 0.2), since)


class RequestsFail(Cause):
    """The model raises errors."""

    name = "requests_fail"
    title = "the model answers without errors"
    needs = frozenset({"answers"})
    explains = frozenset({"plan_dry", "stands_still"})
    remedy = (
        "Read the error: it comes from the model or its server. `ibrobot episodes answers EPISODE` lists all of them."
    )

    @override
    def test(self, window: Window, reference: Reference) -> Evidence | None:
        failed = [each for each in window.asked if each.answer.error]
        if not failed:
            return None
        share = len(failed) / len(window.asked)
        text = f"{_of(len(failed), len(window.asked), 'requests to the model')} failed: {failed[0].answer.error}"
        since = window.since(failed[0].answer.header.stamp_ns)
        return Evidence(text, 100 * share, "%", 5.0, likelihood(share, 0.05, 0.25), since)


class TicksMissed(Cause):
    """The control loop pauses."""

    name = "ticks_missed"
    title = "the control loop keeps its ticks"
    needs = frozenset({"commands", "state"})
    explains = frozenset({"arm_not_following"})
    remedy = (
        "Give the control process its core: see the page on real-time permissions, close what loads the machine, and "
        "let the model run elsewhere (`execution_mode: process`, or a server)."
    )

    @override
    def test(self, window: Window, reference: Reference) -> Evidence | None:
        times = np.unique(window.state.stamps_ns)  # of the control process; receipt also waits for the recorder
        if window.sampled or len(times) < 20:
            return None
        gaps = np.diff(times)
        usual = float(np.median(gaps))
        if usual <= 0:
            return None
        long = gaps > 2.5 * usual
        lost_ns = float((gaps[long] - usual).sum())
        share = lost_ns / float(times[-1] - times[0])
        if not long.any():
            return None
        text = (
            f"The control loop missed {100 * share:.1f} % of its ticks: {counted(int(long.sum()), 'pause')}, the "
            f"longest {gaps.max() / 1e6:.0f} ms with {usual / 1e6:.0f} ms between its states."
        )
        since = window.since(int(times[:-1][long][0]))
        return Evidence(text, 100 * share, "%", 3.0, likelihood(share, 0.03, 0.12), since)


class OtherRate(CardCause):
    """Chunks are executed at another rate than that of the training."""

    name = "other_rate"
    title = "chunks are executed at the rate of the training"
    needs = frozenset({"chunks", "card"})
    explains = frozenset({"other_speed"})
    remedy = (
        "Give the contract the rate of the data (`contract: {rate_hz: …}`), or train on data of this rate; a policy's "
        "actions have the spacing in time that its data had."
    )

    @override
    def compare(self, window: Window, card: Card) -> Evidence | None:
        steps = [each.answer.step_ns for each in window.asked if each.used]
        rate, trained = NS_PER_S / float(np.median(steps)), card.rate_hz
        factor = max(rate / trained, trained / rate)
        text = (
            f"The robot executes chunks at {rate:.3g} Hz, but the model's data has {trained:.3g} Hz: it moves "
            f"{rate / trained:.2g} times as fast as demonstrated."
        )
        return Evidence(text, factor, "times", 1.1, likelihood(factor - 1, 0.1, 0.25))


CAUSES: tuple[type[Cause], ...] = (ObservationLate, AnswersSlow, PlanDry, RequestsFail, TicksMissed, OtherRate)
