"""`uav_twin.watch`: the watch of a real asset, which can look for the cause of its alarms."""

from twin_master.watch.workflow import watch as _watch
from uav_twin.cause_search import with_discrepancy_search

watch = with_discrepancy_search(_watch)
