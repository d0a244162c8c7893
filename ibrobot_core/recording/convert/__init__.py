"""Episodes to datasets: rows at the contract's ticks, joints in the unit asked for, many episodes side by side."""

from ibrobot_core.recording.convert.request import EpisodeReport, Report, Request
from ibrobot_core.recording.convert.run import convert, find_episodes

__all__ = ["EpisodeReport", "Report", "Request", "convert", "find_episodes"]
