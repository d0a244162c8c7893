"""The terminal of runs: its keys, for devices and commands, the live panel, guides, and tables about a run."""

from ibrobot_terminal.guide import Guide as Guide
from ibrobot_terminal.guide import GuideDescriptor as GuideDescriptor
from ibrobot_terminal.guide import PanelDescriptor as PanelDescriptor
from ibrobot_terminal.guide import Question as Question
from ibrobot_terminal.held_keys import HeldKeys as HeldKeys
from ibrobot_terminal.held_keys import KeyEvent as KeyEvent
from ibrobot_terminal.key_reader import KeyReader as KeyReader
