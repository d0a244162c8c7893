"""The terminal of runs: its keys, for devices and commands, and the live panel."""

from ibrobot_terminal.held_keys import HeldKeys as HeldKeys
from ibrobot_terminal.held_keys import KeyEvent as KeyEvent
from ibrobot_terminal.key_reader import KeyReader as KeyReader
