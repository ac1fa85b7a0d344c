"""Prints the checks of a model, and ends the command if a limit is exceeded."""

from collections.abc import Sequence

from fe.verification.wing_checks import Check
from reporting import terminal

HEADINGS = ("check", "figure", "found", "limit", "verdict")


def print_checks(checks: Sequence[Check]) -> None:
    """Print checks as a table; print nothing if there are none."""
    if checks:
        terminal.print_table(HEADINGS, [_row(check) for check in checks])


def _row(check: Check) -> tuple[str, ...]:
    """Return the cells of a check; one without a limit has no verdict either."""
    value = f"{check.value:,}" if isinstance(check.value, int) else f"{check.value:.3g}"
    figure = f"{value} {check.note}".rstrip()
    if check.limit is None:
        return (check.group, check.name, figure)
    verdict = "kept" if check.passed else "BROKEN"
    return (check.group, check.name, figure, f"{check.limit:.3g}", verdict)


def exit_if_broken(checks: Sequence[Check]) -> None:
    """End the command with exit code 1 and a message if any check exceeds its limit."""
    broken = [f"{check.group}, {check.name}" for check in checks if not check.passed]
    if broken:
        raise terminal.error_exit(
            f"{len(broken)} of {len(checks)} checks exceeded their limits: {'; '.join(broken)}."
        )
