"""The page of a fleet: health of its assets, who needs attention next, what was learnt, failures.

The page is made from the folder of the fleet alone, which may still be growing. Its size does not
grow with the number of assets: it has a cell of a map for each, and tables of the few that matter.
"""

import json
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from reporting.arrays import Float, Index
from reporting.files import atomic_write_text
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
from twin_master.fleet.store import ENDED, FAILED, NOTICE_KINDS, WITHIN, flown_rows, open_group
from twin_master.fleet.watched_asset import counts_of, read_standing
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
    """Write the page of a fleet.

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
    """Return the page of a fleet as it stands.

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
        If it is damaged.
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


def _subtitle(fleet: Mapping[str, Any], *, is_watched: bool) -> str:
    """Return the size of a fleet, its seed, and whether it is watched or flown."""
    group_count = counted(len(fleet["groups"]), "group")
    if is_watched:  # the configuration does not know which assets there are
        return f"{group_count}, seed {fleet['seed']}, watched"
    asset_count = sum(len(group.get("members", ())) for group in fleet["groups"])
    return f"{counted(asset_count, 'asset')} in {group_count}, seed {fleet['seed']}, flown"


def _add_flown_fleet(
    page: Page, folder: Path, records: Sequence[dict[str, Any]], most_assets: int
) -> None:
    """Add the sections of a fleet that is flown; records are its groups in `config.json`."""
    groups = {record["name"]: open_group(folder, record["name"]) for record in records}
    standings = [standing_of_flown(record, groups[record["name"]]) for record in records]
    page.add_paragraph(_opening(standings, list(groups.values())))
    figures = {name: group_figures(group) for name, group in groups.items()}
    WORDS.add_table(page, "fared", figure_rows(figures), more=list(figures))
    status = np.concatenate([group["status"].values for group in groups.values()])
    failures = endings_of(folder).failures
    if failures:
        page.add_notice(
            f"{len(failures)} of {len(status)} assets failed in flight; their twins end there."
        )
    _add_failures(page, failures, "All of them stand in fleet.json once the fleet has flown.")
    ended_early = int(np.sum(status == ENDED))
    if ended_early:
        page.add_notice(
            f"{ended_early} of {len(status)} assets ended their simulation before the mission "
            "was over; what they have flown counts."
        )
    _add_lessons(page, folder)
    for record, standing in zip(records, standings, strict=True):
        group = groups[record["name"]]
        page.add_section(f"Group {record['name']}")
        leaving = _leaving_or_explanation(page, folder, record, group)
        if leaving is not None:
            standing = replace(standing, leaving=leaving)
        failed = int(np.sum(group["status"].values == FAILED))
        _add_map(page, standing, failed)
        _add_courses(page, standing, group)
        _add_attention_table(page, standing, most_assets)


def _leaving_or_explanation(
    page: Page, folder: Path, record: Mapping[str, Any], group: "xr.Dataset"
) -> Float | None:
    """Return the probabilities that the flown twins of a group leave their controls soon.

    If they cannot be computed, the page says why, and None is returned.
    """
    try:
        probabilities = leaving_probabilities(folder, record, group)
    except TwinMasterError as error:
        page.add_paragraph(in_one_line(f"Who leaves its control soon is not known: {error}"))
        return None
    return probabilities[flown_rows(group["status"].values)]


def _opening(standings: Sequence[Standing], groups: "Sequence[xr.Dataset]") -> str:
    """Return what a reader wants to know first: flights, alarms, fallbacks, the worst damage."""
    asset_count = sum(group.sizes["twin"] for group in groups)
    flown_count = sum(len(standing.names) for standing in standings)
    sentences = [
        f"{flown_count} of {counted(asset_count, 'asset')} have flown.",
        _alarm_sentence(standings[0].scenario.mission.step_name, groups),
        _fallback_sentence(standings[0].scenario.mission.step_name, groups),
        _damage_sentence(standings),
    ]
    return " ".join(sentence for sentence in sentences if sentence)


def _alarm_sentence(step_word: str, groups: "Sequence[xr.Dataset]") -> str:
    """Return how many assets raised an alarm, and in which step the first; empty if none did."""
    alarm = NOTICE_KINDS.index("alarm")
    first_alarm = np.concatenate([group["first_notice"].values[:, alarm] for group in groups])
    raised = first_alarm[first_alarm >= 0]
    if not len(raised):
        return ""
    return f"{counted(len(raised), 'asset')} raised an alarm, first in {step_word} {min(raised)}."


def _fallback_sentence(step_word: str, groups: "Sequence[xr.Dataset]") -> str:
    """Return how often the control fell back in time; empty if no damage called for it."""
    delay = np.concatenate([group["delay"].values for group in groups])
    called_for = delay[~np.isnan(delay)]
    if not len(called_for):
        return ""
    fraction_in_time = float(np.mean(called_for <= WITHIN))
    return (
        f"In {counted(len(called_for), 'asset')} the damage called for another control; "
        f"the fallback came within {WITHIN} {step_word}s of it in {100 * fraction_in_time:.0f} %."
    )


def _damage_sentence(standings: Sequence[Standing]) -> str:
    """Return which asset is damaged most severely, and its state; empty if no state is believed."""
    believed = [standing for standing in standings if standing.most_damaged is not None]
    if not believed:
        return ""
    worst_group = max(believed, key=lambda standing: np.nanmax(standing.severity))
    number = worst_group.most_damaged
    assert number is not None
    states = []
    for factor, mean in zip(
        printed_factors(worst_group.scenario), worst_group.mean[number], strict=True
    ):
        states.append(f"{factor.title} {factor.scale * mean:.3g} {factor.unit}".rstrip())
    name = worst_group.names[number]
    return f"The worst off is {name} of {worst_group.group}: {', '.join(states)}."


def _add_watched_fleet(
    page: Page, folder: Path, groups: Sequence[dict[str, Any]], most_assets: int
) -> None:
    """Add the sections of a fleet that is watched; groups are those in `config.json`."""
    standing = read_standing(folder)
    assets = standing["assets"]
    failures = standing["failures"]
    decided = {name: asset for name, asset in assets.items() if asset["last"] is not None}
    page.add_highlights([(str(count), title) for title, count in counts_of(standing).items()])
    if failures:
        asset_count = counted(len(assets | failures), "asset")
        page.add_notice(f"{len(failures)} of {asset_count} are not watched.")
    _add_failures(page, failures, "They stand in watched.json.")
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
    """Add a table of why flights or watches ended, the most frequent reasons first.

    Parameters
    ----------
    page : Page
        The page.
    failures : mapping of str to str
        The reason for each asset, by its name.
    caption : str
        Where all failures stand.
    """
    rows = []
    for reason, count in Counter(failures.values()).most_common(_FAILURE_ROWS):
        names = [name for name, its_reason in failures.items() if its_reason == reason]
        examples = ", ".join(names[:_FAILURE_EXAMPLES])
        if count > _FAILURE_EXAMPLES:
            examples += ", ..."
        rows.append([reason, str(count), examples])
    WORDS.add_table(page, "failures", rows, caption=caption)


def _add_lessons(page: Page, folder: Path) -> None:
    """Add what was learnt across the fleet beside what was assumed, if `fleet learn` has run."""
    path = folder / LESSONS_NAME
    if path.is_file():
        page.add_section("Learnt across the fleet")
        WORDS.add_table(page, "lessons", lesson_rows(json.loads(path.read_text())))


def _add_map(page: Page, standing: Standing, failed: int) -> None:
    """Add the map of the assets of a group by health, of which some failed in flight."""
    if not standing.names:
        page.add_paragraph("Nothing is known of its assets yet.")
        return
    figure = map_figure(standing.scenario, standing.mean, failed)
    failed_sentence = f"Grey: {failed} that failed in flight." if failed else ""
    page.add_report_figure(WORDS.figure("map", figure, failed=failed_sentence))


def _add_courses(page: Page, standing: Standing, group: "xr.Dataset") -> None:
    """Add the health of the assets of a group over time, if a state is believed in any step."""
    flown = flown_rows(group["status"].values)
    mean = believed_means(group)[flown]
    if standing.names and not np.isnan(mean).all():
        figure = course_figure(standing.scenario, mean, group["state"].values[flown])
        page.add_report_figure(WORDS.figure("course", figure))


class _AttentionTable(NamedTuple):
    """The columns beside name and step of a table of assets, and its rows."""

    columns: list[PageColumn]
    rows: list[list[str]]


def _add_attention_table(page: Page, standing: Standing, most_assets: int) -> None:
    """Add the table of the assets of a group that need attention next."""
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
    """Return the probability of leaving a control in whole percent, a (B,) array; 0 if unknown."""
    return np.asarray(np.rint(100.0 * np.nan_to_num(standing.leaving)))


def _attention_order(standing: Standing) -> Index:
    """Return the numbers of assets by alarms, then by leaving a control soon, then by damage.

    Assets in no state that is believed count as the most damaged.
    """
    damage = np.nan_to_num(standing.severity, nan=np.inf)
    # The last key counts first.
    return np.lexsort((-damage, -_leaving_percentage(standing), -standing.alarms))


def _attention_table(
    standing: Standing, order: Iterable[int], *, has_alarms: bool
) -> _AttentionTable:
    """Return the table of assets in an order, with a column of alarms if there are any."""
    factors = printed_factors(standing.scenario)
    columns = []
    for state, factor in zip(standing.scenario.state, factors, strict=True):
        columns.append(number_column(state.name, factor.unit))
    columns += [PageColumn("control"), number_column("change", "%")]
    if has_alarms:
        columns.append(number_column("alarms"))
    percentage = _leaving_percentage(standing)
    rows = []
    for number in order:
        is_leaving_known = not np.isnan(standing.leaving[number])
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
    """Return mean and standard deviation of each factor of the state of an asset, as printed."""
    cells = []
    for index, factor in enumerate(factors):
        mean = factor.scale * standing.mean[number, index]
        deviation = factor.scale * standing.deviation[number, index]
        if np.isnan(mean):
            cells.append("not believed")
        else:
            cells.append(f"{mean:.1f}\N{NO-BREAK SPACE}±\N{NO-BREAK SPACE}{deviation:.1f}")
    return cells
