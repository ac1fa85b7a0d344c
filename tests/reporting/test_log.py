"""Library code prints nothing: it has one logger, which a user configures and a command shows."""

import ast
import logging
from pathlib import Path

import pytest

from reporting import progress
from reporting.system.log import PACKAGE_LOGGER, module_logger, shown_log
from tests.test_architecture import MAY_IMPORT, source_files


def test_notes_of_library_code_are_records_of_the_log(caplog):
    with caplog.at_level(logging.INFO, logger="uav_twin"):
        progress.reporter().note("The run is finished.")
    ((name, level, message),) = caplog.record_tuples
    assert (name.split(".")[0], level, message) == (
        "uav_twin",
        logging.INFO,
        "The run is finished.",
    )


def test_a_command_shows_warnings_line_by_line_and_leaves_the_logger_as_it_was():
    lines: list[str] = []
    former = PACKAGE_LOGGER.level, list(PACKAGE_LOGGER.handlers)
    logger = module_logger("fe.reduction")
    with shown_log(lines.append, logging.WARNING):
        logger.warning("What is kept is built anew: %s", "damaged")
        logger.info("not shown")
    logger.warning("after the command")
    assert lines == ["What is kept is built anew: damaged"]
    assert (PACKAGE_LOGGER.level, PACKAGE_LOGGER.handlers) == former


OTHER_LOGGERS = {"twin_master.fleet.engine"}
"""Modules that silence the log of another package."""
PRINTING = {"twin_master.__main__", "reporting.terminal"}


@pytest.mark.parametrize("package", sorted(MAY_IMPORT))
def test_library_code_has_no_print_and_no_logger_of_its_own(package):
    wrong = []
    for name, path in source_files().items():
        if name.split(".")[0] != package or name in {*PRINTING, "reporting.system.log"}:
            continue
        for node in ast.walk(ast.parse(Path(path).read_text(encoding="utf-8"))):
            if not isinstance(node, ast.Call):
                continue
            called = ast.unparse(node.func)
            if called == "print" or (called == "logging.getLogger" and name not in OTHER_LOGGERS):
                wrong.append(f"{name}: {called} in line {node.lineno}")
    assert not wrong
