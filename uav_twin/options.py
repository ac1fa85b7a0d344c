"""How the commands of this package print their results."""

from functools import partial

from reporting import terminal

show = partial(terminal.show, words="uav_twin")
"""Prints what a command found, see `terminal.show`; by default in the words of this package."""
answer = partial(terminal.answer, words="uav_twin")
"""Prints a record as JSON, or as `show` does."""
