"""The report of a fleet: health of its assets, assets to attend to next, lessons, failures.

The page is made from the folder of the fleet alone, which may still be growing. Its size does not
grow much with the number of assets: each has one cell of a map, of which there are ten thousand at
most, and the tables have few rows.
"""

import json
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from reporting.arrays import Float
from reporting.files import atomic_write_text
from reporting.json_file import JsonObject, JsonRecord
from reporting.pages.figures import page_figure
from reporting.pages.page import (
    Block,
    Highlights,
    Notice,
    Page,
    PageFigure,
    Section,
    render_page,
)
from reporting.pages.page_words import Words
from reporting.pages.table import PageColumn, Table, number_column
from reporting.words import counted
from twin_master.errors import FleetError
from twin_master.fleet.comparison import group_statistics, returns_of_group, statistic_rows
from twin_master.fleet.configuration import fleet_config
from twin_master.fleet.flight import endings_of
from twin_master.fleet.learning.lessons import LESSONS_NAME, lesson_rows
from twin_master.fleet.members import RecordedMembers
from twin_master.fleet.page.asset_states import AssetStates, states_of_watched_assets
from twin_master.fleet.page.overview import GroupOverview, overview_of_group
from twin_master.fleet.page.page_figures import course_figure, map_figure, returns_figure
from twin_master.fleet.reading import open_groups
from twin_master.fleet.storage.store import WITHIN
from twin_master.fleet.watched.watched_asset import read_watched_state, watched_fleet_counts
from twin_master.report.reading import PrintedFactor, printed_factors
from twin_master.run_folder import FLEET_KIND, REPORT_NAME, WATCHED_FLEET_KIND
from twin_master.scenario.schema import Scenario

WORDS = Words("twin_master.fleet.page")
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
    page = fleet_page(folder, ATTENTION_ROWS)
    return atomic_write_text(folder / REPORT_NAME, render_page(page))


def fleet_page(folder: Path, most_assets: int) -> Page:
    """Return the page of a fleet, flown or watched.

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
    config = fleet_config(folder, FLEET_KIND, WATCHED_FLEET_KIND)
    is_watched = config["kind"] == WATCHED_FLEET_KIND
    fleet = config["fleet"]
    add_content = _watched_fleet_page if is_watched else _flown_fleet_page
    before = f"{folder} is damaged or of another version ("
    with FleetError.instead_of(KeyError, TypeError, AttributeError, before=before, after=")."):
        page = Page(fleet["title"] or fleet["name"], _subtitle(fleet, is_watched=is_watched))
        return add_content(page, folder, fleet["groups"], most_assets)


def _subtitle(fleet: JsonRecord, *, is_watched: bool) -> str:
    """Return the size of a fleet, its seed, and whether it is watched or flown."""
    group_count = counted(len(fleet["groups"]), "group")
    if is_watched:  # the configuration of a watched fleet has no list of assets
        return f"{group_count}, seed {fleet['seed']}, watched"
    asset_count = sum(len(RecordedMembers(group)) for group in fleet["groups"])
    return f"{counted(asset_count, 'asset')} in {group_count}, seed {fleet['seed']}, flown"


def _flown_fleet_page(
    page: Page, folder: Path, records: Sequence[JsonObject], most_assets: int
) -> Page:
    """Return the page of a flown fleet, given the records of its groups in `config.json`."""
    groups = open_groups(folder)
    overviews = [
        overview_of_group(folder, record, groups[record["name"]], most_assets) for record in records
    ]
    asset_count = sum(overview.twin_count for overview in overviews)
    failures, _ = endings_of(folder)
    ended_early = sum(overview.ended_count for overview in overviews)
    notices: list[Block] = []
    if failures:
        notices.append(
            Notice(
                f"{len(failures)} of {asset_count} assets failed in flight; their twins end there."
            )
        )
    if ended_early:
        notices.append(
            Notice(
                f"{ended_early} of {asset_count} assets ended their simulation before the mission "
                "was over; what they have flown counts."
            )
        )
    returns = {name: returns_of_group(group) for name, group in groups.items()}
    returns_picture = None
    if any(len(values) for values in returns.values()):
        returns_picture = page_figure(WORDS.figure("returns", returns_figure(returns)))
    statistics = {name: group_statistics(group) for name, group in groups.items()}
    columns = [number_column(group) for group in statistics]
    results = [returns_picture, WORDS.table("fared", statistic_rows(statistics), columns)]
    failure_table = _failure_table(
        failures, "fleet.json lists all of them once the fleet has flown."
    )
    sentences = _opening_sentences(overviews)
    picture, sections = _first_map([_flown_group_section(overview) for overview in overviews])
    return replace(
        page,
        sentence=" ".join(sentences[:2]),
        picture=picture,
        outcome=[*notices, " ".join(sentences[2:])],
        sections=[
            *sections,
            Section("Results of the twins", results),
            Section("Failures", [failure_table]),
            _lessons_section(folder),
        ],
    )


def _first_map(sections: Sequence[Section]) -> tuple[PageFigure | None, list[Section]]:
    """Take the map of the first group that has one out of its section, for the first screen."""
    for number, section in enumerate(sections):
        map_of_group, *others = section.blocks
        if isinstance(map_of_group, PageFigure):
            remaining = list(sections)
            remaining[number] = Section(section.title, others)
            return map_of_group, remaining
    return None, list(sections)


def _flown_group_section(overview: GroupOverview) -> Section:
    """Return the section of a group of a flown fleet; its map is the first block."""
    reason = ""
    if overview.leaving_unknown_because:
        reason = (
            "It is not known which assets will soon change their control: "
            f"{overview.leaving_unknown_because}"
        )
    scenario = overview.urgent.scenario
    drawn = overview.drawn
    sample = ""
    if drawn.distance > 1:
        sample = f"Of {overview.twin_count} assets, one in {drawn.distance} is drawn."
    mean = np.concatenate(drawn.mean)
    course = None
    if not np.isnan(mean).all():
        figure = course_figure(scenario, mean, np.concatenate(drawn.state))
        course = page_figure(WORDS.figure("course", figure, more=sample))
    name = overview.record["name"]
    return Section(
        f"Group {name}",
        [
            _map(scenario, name, np.concatenate(drawn.last_mean), drawn.failed_count, sample),
            reason,
            course,
            _attention(
                overview.urgent, overview.flown_count, has_alarms=overview.alarmed_count > 0
            ),
        ],
    )


def _opening_sentences(overviews: Sequence[GroupOverview]) -> list[str]:
    """Return the sentences on flights, alarms, fallbacks and the most severe damage."""
    asset_count = sum(overview.twin_count for overview in overviews)
    flown_count = sum(overview.flown_count for overview in overviews)
    step_word = overviews[0].urgent.scenario.mission.step_name
    sentences = [f"{flown_count} of {counted(asset_count, 'asset')} have flown."]

    # The assets with an alarm, and the first step of one
    alarms = [overview.first_alarm for overview in overviews if overview.first_alarm is not None]
    if alarms:
        alarmed = counted(sum(overview.alarmed_count for overview in overviews), "asset")
        sentences.append(f"{alarmed} raised an alarm, first in {step_word} {min(alarms)}.")

    # The fraction of fallbacks that came in time
    called_for_count = sum(overview.prompt_fallbacks.trials for overview in overviews)
    if called_for_count:
        prompt_count = sum(overview.prompt_fallbacks.hits for overview in overviews)
        percentage = 100 * (prompt_count / called_for_count)
        sentences.append(
            f"In {counted(called_for_count, 'asset')} the damage called for another control; "
            f"the fallback came within {WITHIN} {step_word}s of it in {percentage:.0f} %."
        )

    # The most severe damage, if a state is estimated
    candidates = [overview.most_damaged for overview in overviews]
    with_state = [candidate for candidate in candidates if candidate is not None]
    if with_state:
        worst = max(with_state, key=lambda candidate: float(candidate.severity[0]))
        states = []
        for factor, mean in zip(printed_factors(worst.scenario), worst.mean[0], strict=True):
            states.append(f"{factor.title} at {factor.scale * mean:.3g} {factor.unit}".rstrip())
        asset = f"{worst.names[0]} of {worst.group}"
        sentences.append(f"The asset with the most damage is {asset}: {', '.join(states)}.")
    return sentences


def _watched_fleet_page(
    page: Page, folder: Path, groups: Sequence[JsonObject], most_assets: int
) -> Page:
    """Fill the page of a watched fleet from the state of its assets that `folder` holds.

    `groups` are the records of the fleet's groups.
    """
    state = read_watched_state(folder)
    assets = state["assets"]
    failures = state["failures"]
    stepped_assets = {name: asset for name, asset in assets.items() if asset["last"] is not None}
    counts = watched_fleet_counts(state)
    asset_count = counted(len(assets | failures), "asset")
    notices: list[Block] = []
    if failures:
        notices.append(Notice(f"{len(failures)} of {asset_count} are not watched."))
    without_step = sorted(assets.keys() - stepped_assets.keys() - failures.keys())
    if without_step:
        names = ", ".join(without_step[:most_assets])
        more = ", ..." if len(without_step) > most_assets else ""
        count = counted(len(without_step), "asset")
        notices.append(Notice(f"Without a step yet: {count} ({names}{more})."))
    group_sections = []
    for record in groups:
        states = states_of_watched_assets(record, stepped_assets)
        urgent = states.of_assets(states.attention_order[:most_assets])
        attention = _attention(urgent, len(states.names), has_alarms=bool(states.alarms.any()))
        name = record["name"]
        blocks = [_map(states.scenario, name, states.mean, failed=0), attention]
        group_sections.append(Section(f"Group {name}", blocks))
    picture, sections = _first_map(group_sections)
    return replace(
        page,
        sentence=f"{len(stepped_assets)} of {asset_count} have taken a step.",
        picture=picture,
        outcome=[Highlights([(str(count), title) for title, count in counts.items()]), *notices],
        sections=[
            Section("Failures", [_failure_table(failures, "watched.json lists them.")]),
            *sections,
            _lessons_section(folder),
        ],
    )


def _failure_table(failures: Mapping[str, str], caption: str) -> Table:
    """Return a table of the errors that ended flights or watches, most frequent first.

    `failures` has the error of each asset, and the caption names the file with all of them.
    """
    rows = []
    for reason, count in Counter(failures.values()).most_common(_FAILURE_ROWS):
        names = [name for name, failure_reason in failures.items() if failure_reason == reason]
        examples = ", ".join(names[:_FAILURE_EXAMPLES])
        if count > _FAILURE_EXAMPLES:
            examples += ", ..."
        rows.append([reason, str(count), examples])
    return WORDS.table("failures", rows, caption=caption)


def _lessons_section(folder: Path) -> Section:
    """Return the learnt and the assumed values, if `fleet learn` has been run on the fleet."""
    path = folder / LESSONS_NAME
    rows = lesson_rows(json.loads(path.read_text())) if path.is_file() else []
    return Section("Learnt across the fleet", [WORDS.table("lessons", rows)])


def _map(
    scenario: Scenario, group: str, mean: Float, failed: int, sample: str = ""
) -> PageFigure | str:
    """Return the map of the states (B, F) of a group's assets, in SI units.

    Assets that failed in flight are grey; `sample` says which assets are drawn if not all are.
    """
    if not len(mean):
        return "Nothing is known of its assets yet."
    figure = map_figure(scenario, mean, failed)
    failed_sentence = f"Grey: {failed} that failed in flight." if failed else ""
    more = f"{failed_sentence} {sample}".strip()
    return page_figure(WORDS.figure("map", figure, group=group, more=more))


def _attention(urgent: AssetStates, asset_count: int, *, has_alarms: bool) -> Table | str:
    """Return the table of the assets that need attention first.

    If none needs attention, the result is a sentence that says so. `asset_count` is the number of
    assets of which the most urgent ones were chosen.
    """
    if not urgent.names:
        return ""
    urgent = urgent.of_assets(np.flatnonzero(urgent.needs_attention))
    mission = urgent.scenario.mission
    if not urgent.names:
        return (
            "No asset raised an alarm, and none will probably change its control within "
            f"{mission.prediction_steps} {mission.step_name}s."
        )
    factors = printed_factors(urgent.scenario)
    columns = [number_column(factor.title, factor.unit) for factor in factors]
    columns += [PageColumn("control"), number_column("probability of a change of control", "%")]
    if has_alarms:
        columns.append(number_column("alarms"))
    percentage = urgent.leaving_percentage
    rows = []
    for number, name in enumerate(urgent.names):
        is_leaving_known = not np.isnan(urgent.leaving_probability[number])
        row = [
            name,
            str(urgent.step[number]),
            *_state_cells(urgent, factors, number),
            urgent.control[number],
            f"{percentage[number]:.0f}" if is_leaving_known else "",
        ]
        if has_alarms:
            row.append(str(urgent.alarms[number] or ""))
        rows.append(row)
    return WORDS.table(
        "next",
        rows,
        columns,
        shown=len(rows),
        assets=counted(asset_count, "asset"),
        alarms="alarms, then by " if has_alarms else "",
        steps=f"{mission.prediction_steps} {mission.step_name}s",
        step=mission.step_name,
    )


def _state_cells(states: AssetStates, factors: Sequence[PrintedFactor], number: int) -> list[str]:
    """Return one cell for each factor of an asset's state: mean and standard deviation, printed."""
    cells = []
    for index, factor in enumerate(factors):
        mean = factor.scale * states.mean[number, index]
        deviation = factor.scale * states.deviation[number, index]
        if np.isnan(mean):
            cells.append("not believed")
        else:
            cells.append(f"{mean:.1f}\N{NO-BREAK SPACE}±\N{NO-BREAK SPACE}{deviation:.1f}")
    return cells
