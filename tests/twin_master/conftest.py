"""What tests of missions share."""

from collections.abc import Iterator

import pytest

from twin_master import workflow


@pytest.fixture(scope="module")
def no_report() -> Iterator[None]:
    """The report has tests of its own and takes seconds."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(workflow, "_report", lambda folder: (folder / "report.html").touch())
        yield
