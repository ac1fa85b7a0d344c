"""Options that commands of all packages share, as annotations of their parameters for Typer."""

from typing import Annotated

import typer

LARGEST_SEED = 2**63 - 1
"""The largest seed, that of a signed integer of 64 bits."""

JsonOption = Annotated[
    bool, typer.Option("--json", help="Print the result as JSON, and nothing else.")
]
"""Whether a command prints JSON instead of text."""

NoReportOption = Annotated[bool, typer.Option("--no-report", help="Draw no report and no figures.")]
"""Whether a command leaves out its report."""
