"""The command `uav-twin watch`, which can look for the cause of its alarms."""

import inspect

from twin_master import watch_command
from uav_twin.cause_search import with_discrepancy_search

watch = with_discrepancy_search(watch_command.watch)

# The options of a command are read from its signature, and the search is not an option
_SIGNATURE = inspect.signature(watch_command.watch)
_OPTIONS = [option for name, option in _SIGNATURE.parameters.items() if name != "cause_search"]
vars(watch)["__signature__"] = _SIGNATURE.replace(parameters=_OPTIONS)
