"""The log of the package: all that library code has to say in addition to its results.

Library code prints nothing. Its modules have loggers below the one logger `uav_twin`, which a user
configures as that of any other package: ``logging.getLogger("uav_twin").setLevel("DEBUG")``. A
command shows the log on the error stream.
"""

import logging
from collections.abc import Callable, Iterator
from contextlib import contextmanager

PACKAGE_LOGGER = logging.getLogger("uav_twin")
"""The logger above those of all modules.

It has no handler of its own. So Python prints warnings, such as that a flight may be wrong, for
users who have not configured any log.
"""


def module_logger(module: str) -> logging.Logger:
    """Return the logger of a module.

    Parameters
    ----------
    module : str
        The name of the module, its `__name__`.
    """
    return PACKAGE_LOGGER.getChild(module)


class _LineHandler(logging.Handler):
    """Shows each record of the log as one line."""

    def __init__(self, show: Callable[[str], None]) -> None:
        super().__init__()
        self._show = show

    def emit(self, record: logging.LogRecord) -> None:
        """Show the message of a record."""
        self._show(self.format(record))


@contextmanager
def shown_log(show: Callable[[str], None], level: int) -> Iterator[None]:
    """Return a context in which each message of the log is passed to a function as a line.

    The level of the package's logger is `level` meanwhile, and is restored at the end.

    Parameters
    ----------
    show : callable
        Shows one line.
    level : int
        The lowest level that is shown, such as `logging.WARNING`.
    """
    handler = _LineHandler(show)
    handler.setLevel(level)
    former_level = PACKAGE_LOGGER.level
    PACKAGE_LOGGER.addHandler(handler)
    PACKAGE_LOGGER.setLevel(level)
    try:
        yield
    finally:
        PACKAGE_LOGGER.removeHandler(handler)
        PACKAGE_LOGGER.setLevel(former_level)
