"""What the commands of this package have in common, and why options are refused: a file of sentences."""

from functools import partial

from reporting import terminal
from reporting.sentences import Sentences

said = Sentences(__file__).said
show = partial(terminal.show, words="uav_twin")
"""Prints what a command found, see `terminal.show`; by default in the words of this package."""
answer = partial(terminal.answer, words="uav_twin")
"""Prints a record as JSON, or as `show` does."""
