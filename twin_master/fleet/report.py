"""The report of a fleet: health of its assets, assets to attend to next, lessons, failures.

The page is made from the folder of the fleet alone, which may still be growing. Its size does not
grow much with the number of assets: each has one cell of a map, and the tables have few rows.
"""

import json
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from reporting.arrays import Float, Index
from reporting.files import atomic_write_text
from reporting.json_file import JsonObject, JsonRecord
from reporting.page import Page, PageColumn, Words, number_column
from reporting.words import counted, in_one_line
from twin_master.errors import FleetError, TwinMasterError
from twin_master.fleet.configuration import KIND, REPORT_NAME, WATCHED_KIND, fleet_config
from twin_master.fleet.flight import endings_of
from twin_master.fleet.lessons import LESSONS_NAME, lesson_rows
from twin_master.fleet.page_figures import course_figure, map_figure
from twin_master.fleet.reading import (
    believed_means,
    figure_rows,
    group_figures,
    leaving_probabilities,
)
from twin_master.fleet.standing import Standing, standing_of_flown, standing_of_watched
from twin_master.fleet.store import ENDED, FAILED, WITHIN, flown_rows, open_group
from twin_master.fleet.store_layout import NOTICE_KINDS, stored_values
from twin_master.fleet.watched_asset import read_standing, watched_fleet_counts
from twin_master.report.reading import PrintedFactor, printed_factors

if TYPE_CHECKING:
    import xarray as xr


WORDS = Words("twin_master.fleet")
"""The texts of the page."""
ATTENTION_ROWS = 15
"""Rows of the table of assets that need attention next, in the report."""
_FAILURE_ROWS = 10
"""Rows of the table of failures, the most frequent first."""
_FAILURE_EXAMPLES = 3
"""Assets that are named for each failure."""


def write_fleet_report(folder: Path | str) -> Path:
    """Write the report of a fleet as `report.html` into the folder of the fleet.

    Parameters
    ----------
    folder : Path or str
        The folder of the fleet.

    Returns
    -------
    Path
        The path of the page.

    Raises
    ------
    RunFolderError
        If the folder does not hold a fleet.
    FileNotWrittenError
        If the disk is full or the folder cannot be written.
    """
    folder = Path(folder)
    return atomic_write_text(folder / REPORT_NAME, fleet_page(folder, ATTENTION_ROWS))


def fleet_page(folder: Path, most_assets: int) -> str:
    """Return the report of a fleet, flown or watched, as HTML.

    Parameters
    ----------
    folder : Path
        The folder of the fleet.
    most_assets : int
        The largest number of rows in the table of assets that need attention next.

    Raises
    ------
    RunFolderError
        If the folder does not hold a fleet.
    FleetError
        If the configuration or the results in the folder are damaged.
    """
    config = fleet_config(folder, KIND, WATCHED_KIND)
    is_watched = config["kind"] == WATCHED_KIND
    fleet = config["fleet"]
    groups = fleet["groups"]
    page = Page(fleet["title"] or fleet["name"], _subtitle(fleet, is_watched=is_watched))
    page.add_section("The fleet")
    before = f"{folder} is damaged or of another version ("
    with FleetError.instead_of(KeyError, TypeError, AttributeError, before=before, after=")."):
        if is_watched:
            _add_watched_fleet(page, folder, groups, most_assets)
        else:
            _add_flown_fleet(page, folder, groups, most_assets)
    return page.render()


def _subtitle(fleet: JsonRecord, *, is_watched: bool) -> str:
    """Return the size of a fleet, its seed, and whether it is watched or flown."""
    group_count = counted(len(fleet["groups"]), "group")
    if is_watched:  # the configuration of a watched fleet has no list of assets
        return f"{group_count}, seed {fleet['seed']}, watched"
    asset_count = sum(len(group.get("members", ())) for group in fleet["groups"])
    return f"{counted(asset_count, 'asset')} in {group_count}, seed {fleet['seed']}, flown"


def _add_flown_fleet(
    page: Page, folder: Path, records: Sequence[JsonObject], most_assets: int
) -> None:
    """Add the sections of a flown fleet, given the records of its groups in `config.json`."""
    groups = {record["name"]: open_group(folder, record["name"]) for record in records}
    standings = [standing_of_flown(record, groups[record["name"]]) for record in records]
    page.add_paragraph(_opening(standings, list(groups.values())))
    status = np.concatenate([stored_values(group, "status") for group in groups.values()])
    failures = endings_of(folder).failures
    if failures:
        page.add_notice(
            f"{len(failures)} of {len(status)} assets failed in flight; their twins end there."
        )
    _add_failures(page, failures, "fleet.json lists all of them once the fleet has flown.")
    ended_early = int(np.sum(status == ENDED))
    if ended_early:
        page.add_notice(
            f"{ended_early} of {len(status)} assets ended their simulation before the mission "
            "was over; what they have flown counts."
        )
    for record, standing in zip(records, standings, strict=True):
        group = groups[record["name"]]
        page.add_section(f"Group {record['name']}")
        leaving_probability = _leaving_or_explanation(page, folder, record, group)
        if leaving_probability is not None:
            standing = replace(standing, leaving_probability=leaving_probability)
        failed = int(np.sum(stored_values(group, "status") == FAILED))
        _add_map(page, standing, failed)
        _add_courses(page, standing, group)
        _add_attention_table(page, standing, most_assets)
    page.add_section("Results of the twins")
    figures = {name: group_figures(group) for name, group in groups.items()}
    WORDS.add_table(
        page, "fared", figure_rows(figures), more=[number_column(group) for group in figures]
    )
    _add_lessons(page, folder)


def _leaving_or_explanation(
    page: Page, folder: Path, record: JsonRecord, group: "xr.DataTree"
) -> Float | None:
    """Return for each flown twin of a group the probability that its control changes soon.

    The probabilities are those of `leaving_probabilities`. If they cannot be computed, add a
    paragraph with the reason to the page, and return None.
    """
    try:
        probabilities = leaving_probabilities(folder, record, group)
    except TwinMasterError as error:
        page.add_paragraph(
            in_one_line(f"It is not known which assets will soon change their control: {error}")
        )
        return None
    return probabilities[flown_rows(stored_values(group, "status"))]


def _opening(standings: Sequence[Standing], groups: "Sequence[xr.DataTree]") -> str:
    """Return the opening sentences: on flights, alarms, fallbacks and the most severe damage."""
    asset_count = sum(group.sizes["twin"] for group in groups)
    flown_count = sum(len(standing.names) for standing in standings)
    step_word = standings[0].scenario.mission.step_name
    sentences = [
        f"{flown_count} of {counted(asset_count, 'asset')} have flown.",
        _alarm_sentence(step_word, groups),
        _fallback_sentence(step_word, groups),
        _damage_sentence(standings),
    ]
    return " ".join(sentence for sentence in sentences if sentence)


def _alarm_sentence(step_word: str, groups: "Sequence[xr.DataTree]") -> str:
    """Return the number of assets with an alarm and the first step of one; empty without alarms."""
    alarm_column = NOTICE_KINDS.index("alarm")
    first_alarm = np.concatenate(
        [stored_values(group, "notice/first_step")[:, alarm_column] for group in groups]
    )
    steps = first_alarm[first_alarm >= 0]  # -1: the twin gave no alarm
    if not len(steps):
        return ""
    return f"{counted(len(steps), 'asset')} raised an alarm, first in {step_word} {min(steps)}."


def _fallback_sentence(step_word: str, groups: "Sequence[xr.DataTree]") -> str:
    """Return the fraction of fallbacks within `WITHIN` steps; empty if none was called for."""
    delay = np.concatenate([stored_values(group, "delay") for group in groups])
    called_for_delays = delay[~np.isnan(delay)]  # NaN: the damage called for no fallback
    if not len(called_for_delays):
        return ""
    fraction_in_time = float(np.mean(called_for_delays <= WITHIN))
    return (
        f"In {counted(len(called_for_delays), 'asset')} the damage called for another control; "
        f"the fallback came within {WITHIN} {step_word}s of it in {100 * fraction_in_time:.0f} %."
    )


def _damage_sentence(standings: Sequence[Standing]) -> str:
    """Return a sentence on the most severely damaged asset; empty if no state is estimated."""
    standings_with_state = [standing for standing in standings if standing.most_damaged is not None]
    if not standings_with_state:
        return ""
    worst_group = max(standings_with_state, key=lambda standing: np.nanmax(standing.severity))
    number = worst_group.most_damaged
    assert number is not None
    states = []
    for factor, mean in zip(
        printed_factors(worst_group.scenario), worst_group.mean[number], strict=True
    ):
        states.append(f"{factor.title} {factor.scale * mean:.3g} {factor.unit}".rstrip())
    name = worst_group.names[number]
    return f"The asset with the most damage is {name} of {worst_group.group}: {', '.join(states)}."


def _add_watched_fleet(
    page: Page, folder: Path, groups: Sequence[JsonObject], most_assets: int
) -> None:
    """Add the sections of a fleet that is watched, given the records of its groups."""
    standing = read_standing(folder)
    assets = standing["assets"]
    failures = standing["failures"]
    decided = {name: asset for name, asset in assets.items() if asset["last"] is not None}
    counts = watched_fleet_counts(standing)
    page.add_highlights([(str(count), title) for title, count in counts.items()])
    if failures:
        asset_count = counted(len(assets | failures), "asset")
        page.add_notice(f"{len(failures)} of {asset_count} are not watched.")
    _add_failures(page, failures, "watched.json lists them.")
    without_step = sorted(assets.keys() - decided.keys() - failures.keys())
    if without_step:
        names = ", ".join(without_step[:most_assets])
        more = ", ..." if len(without_step) > most_assets else ""
        count = counted(len(without_step), "asset")
        page.add_notice(f"Without a step yet: {count} ({names}{more}).")
    _add_lessons(page, folder)
    for record in groups:
        page.add_section(f"Group {record['name']}")
        group_standing = standing_of_watched(record, decided)
        _add_map(page, group_standing, failed=0)
        _add_attention_table(page, group_standing, most_assets)


def _add_failures(page: Page, failures: Mapping[str, str], caption: str) -> None:
    """Add a table of the errors that ended flights or watches, the most frequent errors first.

    Parameters
    ----------
    page : Page
        The page to which content is added.
    failures : mapping of str to str
        The error of each asset, by GROUP/NAME.
    caption : str
        A sentence that names the file with the complete list of failures.
    """
    rows = []
    for reason, count in Counter(failures.values()).most_common(_FAILURE_ROWS):
        names = [name for name, failure_reason in failures.items() if failure_reason == reason]
        examples = ", ".join(names[:_FAILURE_EXAMPLES])
        if count > _FAILURE_EXAMPLES:
            examples += ", ..."
        rows.append([reason, str(count), examples])
    WORDS.add_table(page, "failures", rows, caption=caption)


def _add_lessons(page: Page, folder: Path) -> None:
    """Add a table of learnt and assumed values, if `fleet learn` has been run on the fleet."""
    path = folder / LESSONS_NAME
    if path.is_file():
        page.add_section("Learnt across the fleet")
        WORDS.add_table(page, "lessons", lesson_rows(json.loads(path.read_text())))


def _add_map(page: Page, standing: Standing, failed: int) -> None:
    """Add the map of the states of a group's assets; assets that failed in flight are grey."""
    if not standing.names:
        page.add_paragraph("Nothing is known of its assets yet.")
        return
    figure = map_figure(standing.scenario, standing.mean, failed)
    failed_sentence = f"Grey: {failed} that failed in flight." if failed else ""
    page.add_report_figure(WORDS.figure("map", figure, failed=failed_sentence))


def _add_courses(page: Page, standing: Standing, group: "xr.DataTree") -> None:
    """Add the figure of the assets' states over time, if any step has an estimated state."""
    rows_flown = flown_rows(stored_values(group, "status"))
    mean = believed_means(group)[rows_flown]
    if standing.names and not np.isnan(mean).all():
        figure = course_figure(
            standing.scenario, mean, stored_values(group, "truth/state")[rows_flown]
        )
        page.add_report_figure(WORDS.figure("course", figure))


class _AttentionTable(NamedTuple):
    """The columns after name and step of a table of assets, and the rows with all columns."""

    columns: list[PageColumn]
    rows: list[list[str]]


def _add_attention_table(page: Page, standing: Standing, most_assets: int) -> None:
    """Add the table of the assets that need attention first, of at most `most_assets` rows."""
    if not standing.names:
        return
    order = _attention_order(standing)[:most_assets]
    has_alarms = bool(standing.alarms.any())
    table = _attention_table(standing, order, has_alarms=has_alarms)
    mission = standing.scenario.mission
    WORDS.add_table(
        page,
        "next",
        table.rows,
        more=table.columns,
        shown=len(table.rows),
        assets=counted(len(standing.names), "asset"),
        alarms="alarms, then by " if has_alarms else "",
        steps=f"{mission.prediction_steps} {mission.step_name}s",
        step=mission.step_name,
    )


def _leaving_percentage(standing: Standing) -> Float:
    """Return the probability of a change of control in whole percent, (B,); 0 if it is unknown."""
    return np.asarray(np.rint(100.0 * np.nan_to_num(standing.leaving_probability)))


def _attention_order(standing: Standing) -> Index:
    """Return the indices of the assets in the order in which they need attention.

    The order is by the number of alarms, then by the probability of a change of control, then by
    severity of damage. Assets without an estimated state count as the most damaged.
    """
    damage = np.nan_to_num(standing.severity, nan=np.inf)
    # `lexsort` sorts by its last key first; minus signs give descending order.
    return np.lexsort((-damage, -_leaving_percentage(standing), -standing.alarms))


def _attention_table(
    standing: Standing, order: Iterable[int], *, has_alarms: bool
) -> _AttentionTable:
    """Return the table of the assets with the given indices, in their order."""
    factors = printed_factors(standing.scenario)
    columns = []
    for factor in factors:
        columns.append(number_column(factor.title, factor.unit))
    columns += [PageColumn("control"), number_column("probability of a change of control", "%")]
    if has_alarms:
        columns.append(number_column("alarms"))
    percentage = _leaving_percentage(standing)
    rows = []
    for number in order:
        is_leaving_known = not np.isnan(standing.leaving_probability[number])
        row = [
            standing.names[number],
            str(standing.step[number]),
            *_state_cells(standing, factors, number),
            standing.control[number],
            f"{percentage[number]:.0f}" if is_leaving_known else "",
        ]
        if has_alarms:
            row.append(str(standing.alarms[number] or ""))
        rows.append(row)
    return _AttentionTable(columns, rows)


def _state_cells(standing: Standing, factors: Sequence[PrintedFactor], number: int) -> list[str]:
    """Return one cell for each factor of an asset's state: mean and standard deviation, printed."""
    cells = []
    for index, factor in enumerate(factors):
        mean = factor.scale * standing.mean[number, index]
        deviation = factor.scale * standing.deviation[number, index]
        if np.isnan(mean):
            cells.append("not believed")
        else:
            cells.append(f"{mean:.1f}\N{NO-BREAK SPACE}±\N{NO-BREAK SPACE}{deviation:.1f}")
    return cells
