"""What was received of a step of a watch."""

from enum import IntEnum


class StepStatus(IntEnum):
    """Whether a message of a step has come, and with its control; journals store the numbers."""

    MISSING = 0
    """No message has come."""
    ASSUMED_CONTROL = 1
    """A message without a control has come: the assumed control may be corrected by a later one."""
    WITH_CONTROL = 2
    """A message with its control has come."""
