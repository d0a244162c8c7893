"""The control process: owns the hardware and nothing else, and stops the robot when the host dies.

`ibrobot_core.control.host` starts it as a `Child` with the descriptors MEMORY and WAKE, and then sends the robot's
configuration.
"""

from __future__ import annotations

import contextlib
import logging
import os
import signal
import sys
from collections import deque
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from ibrobot_core.channel import Channel
from ibrobot_core.child import is_stopped, run_child
from ibrobot_core.clock import RealClock
from ibrobot_core.config import from_document
from ibrobot_core.control.commands import Command, EmergencyStop, Halt, decode
from ibrobot_core.control.core import ControlCore
from ibrobot_core.control.link import LinkLayout, SharedMemory
from ibrobot_core.control.phase import Phase
from ibrobot_core.control.realtime import go_real_time
from ibrobot_core.control.timing import REPORT_TICKS, Punctuality
from ibrobot_core.errors import HardwareError
from ibrobot_core.plugins import installed_plugins
from ibrobot_core.safe_output import echo
from ibrobot_core.units import NS_PER_S

_GLANCE_S = 0.03
"""Silence of the host from which its state is looked at [s]."""


class ControlProcess:
    """Runs the loop on absolute deadlines; tells the host when it is `ready`, and when the robot has `arrived`."""

    def __init__(
        self, core: ControlCore, clock: RealClock, channel: Channel, memory: SharedMemory, wake: int, host: int,
        ready: Mapping[str, Any],
    ) -> None:  # fmt: skip
        self._core = core
        self._clock = clock
        self._channel = channel
        self._memory = memory
        self._wake = wake
        self._host = host
        self._ready = ready
        self._arrived = False
        self._waiting: deque[tuple[Any, Command]] = deque()
        """Commands of the host that were received and not executed yet, with their numbers."""
        self._punctuality = Punctuality()
        self._beats = 0
        self._heard_ns = 0
        """When the host last gave a sign of life [ns]."""
        self._ends = False
        self._orphaned = self._terminated = False
        core.take_stops = self._receive

    def run(self) -> None:
        """Tick until the host commands a stop, the host dies, or SIGTERM arrives; then run the stop behaviour.

        A host that dies during the stop behaviour, and a further SIGTERM, are an emergency stop: nobody else can stop
        the motion any more.
        """
        signal.signal(signal.SIGTERM, self._terminate)
        self._report("report")  # the first call is slow, so make it before the first tick
        self._channel.send(self._ready)
        self._handle_commands()  # an emergency stop that came while the hardware was connected lets nothing move
        period = self._core.period_ns
        deadline = self._clock.now_ns() + period
        periods = 1
        while not (self._ends and self._core.stopped):
            self._clock.sleep_until(deadline)
            late = self._clock.now_ns() - deadline
            self._cycle(deadline, late, periods)
            if self._handle_commands():
                # A slow command, e.g. hardware set up again after a fault, does not count as missed ticks.
                deadline, periods = self._clock.now_ns() + period, 1
                continue
            deadline += period
            behind = (self._clock.now_ns() - deadline) // period
            periods = 1 + max(0, behind)
            deadline += max(0, behind) * period
        self._report("stopped", holding=self._core.holding())

    def _cycle(self, deadline: int, late: int, periods: int) -> None:
        self._note_silences(late)
        if (plan := self._memory.read_plan()) is not None:
            self._core.set_plan(plan)
        self._memory.write_state(self._core.tick(deadline, late, periods))
        self._punctuality.tick(deadline, late, periods - 1)
        self._report_to_host()
        # A process forked by the host keeps the socket open after the host's death.
        if not self._orphaned and (self._channel.closed or os.getppid() != self._host):
            self._orphaned = True
            self._end("the host is gone", unmoved=not self._arrived)
        if self._terminated:
            self._terminated = False
            self._end("terminated")
        if not self._arrived and self._core.phase is not Phase.STOPPING and self._core.arrived():
            self._arrived = True
            self._channel.send({"event": "arrived", "generation": self._core.generation})

    def _receive(self) -> None:
        """Receive commands; emergency stops overtake all others."""
        for message in self._channel.receive():
            number = message.get("id")
            if message.get("do") == EmergencyStop.__name__:  # whatever else it says
                self._channel.send({"reply": number, **self._core.handle(EmergencyStop())})
                continue
            try:
                self._waiting.append((number, decode(message)))
            except HardwareError as error:
                self._channel.send({"reply": number, "error": str(error)})

    def _note_silences(self, late: int) -> None:
        """Have the robot brake if the host, or this process, has been stopped or blocked."""
        now_ns, beats = self._clock.now_ns(), self._memory.beats
        if beats != self._beats:
            self._beats, self._heard_ns = beats, now_ns
        self._core.note_silence((late + self._core.period_ns) / NS_PER_S, "the control loop has not run")
        silent_s = (now_ns - self._heard_ns) / NS_PER_S if beats else 0.0
        if silent_s > _GLANCE_S:
            stopped = is_stopped(self._host)
            fault = f"the host process {self._host}{' is stopped, and' if stopped else ''} has been silent"
            self._core.note_silence(silent_s, fault, stopped=stopped)

    def _handle_commands(self) -> bool:
        """Execute the host's commands; return whether this took longer than a period."""
        begun_ns = self._clock.now_ns()
        self._receive()
        while self._waiting:
            number, command = self._waiting.popleft()
            self._channel.send({"reply": number, **self._core.handle(command)})
            self._ends = self._ends or (isinstance(command, Halt) and command.ends)
        return self._clock.now_ns() - begun_ns > self._core.period_ns

    def _report_to_host(self) -> None:
        # A full pipe wakes the host too; a closed pipe shows on the socket.
        with contextlib.suppress(OSError):
            os.write(self._wake, b".")
        while self._core.events:
            self._channel.send(self._core.events.popleft())
        if self._core.state is not None and self._core.state.tick % REPORT_TICKS == 0 and not self._channel.backlog:
            self._report("report")

    def _report(self, event: str, **more: Any) -> None:
        loop, counters = self._punctuality.summary(), self._core.counters()
        self._channel.send({"event": event, "loop": loop, "counters": counters, **more})

    def _end(self, why: str, *, unmoved: bool = False) -> None:
        """End the loop after the stop behaviour; brake if that has begun already."""
        logging.getLogger("ibrobot.control").warning("stopping: %s", why)
        if self._core.phase is Phase.STOPPING and not self._core.stopped:
            self._core.emergency_stop()
        self._ends = True
        self._core.begin_stop(unmoved=unmoved)

    def _terminate(self, number: int, frame: Any) -> None:
        self._terminated = True


def main() -> int:
    """Run the process; returns the exit status."""
    holding: list[str] = []

    def run(channel: Channel, order: Mapping[str, Any], memory: int, wake: int) -> None:
        clock = RealClock(order["epoch_offset_ns"])
        config = from_document(order["document"], source=Path(order["source"]), sim=order["sim"])
        core = ControlCore.of(config, installed_plugins(), clock, order["seed"])
        try:
            core.start(order["mode"])
            shared = SharedMemory(memory, LinkLayout(len(config.robot.joints), core.signal_size))
            os.set_blocking(wake, False)
            signals = [[signal.topic, signal.size] for signal in core.signals]
            ready = {"event": "ready", "signals": signals, "refused": go_real_time(config.control.priority)}
            ControlProcess(core, clock, channel, shared, wake, order["host"], ready).run()
        except Exception:  # a bug here must still stop the robot
            core.abandon()
            holding[:] = core.holding()
            raise
        finally:
            core.close()
            if channel.closed:  # the host can no longer report it
                for line in core.holding():
                    echo(line, err=True)

    return run_child(run, holding)


if __name__ == "__main__":
    sys.exit(main())
