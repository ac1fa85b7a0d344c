"""The sentences at the head of the page."""

import html
from dataclasses import replace

import numpy as np

from twin_master.report import check as report_check
from twin_master.report import data as report_data
from twin_master.report import page as report
from twin_master.report.opening import opening_sentences


def test_the_page_begins_with_what_was_decided_believed_and_explained(record: report_data.RunRecord) -> None:
    decided, believed, explained = opening_sentences(record)
    assert decided == "The twin left 3g for 2g at turn 21."  # by a policy of both states
    mean, deviation = 100 * record.filtered.mean[-1, 0], 100 * record.filtered.standard_deviation[-1, 0]
    low, high = max(mean - 2 * deviation, 0.0), min(mean + 2 * deviation, 80.0)
    assert (
        f"puts the stiffness loss of region 1 at {mean:.1f} % ({low:.1f} to {high:.1f}, truth 60)" in believed
    )
    check = report_check.predictive_check(record)  # 150 µε of noise, 125 assumed
    assert check is not None
    assert f"{check.standard_deviation:.3g} times as far as it assumes" in explained
    assert " ".join(opening_sentences(record)) in " ".join(
        html.unescape(report.render_page(record, [])).replace("\N{NO-BREAK SPACE}", " ").split()
    )


def flown(record: report_data.RunRecord, *gentle: int, **changes: object) -> str:
    """The first sentence of a run that flew 2g at these turns."""
    control = np.ones(50, dtype=np.int64)
    control[list(gentle)] = 0
    policy = report_data.PolicyTable(np.where(record.coordinates[:, 0] > 0.59, 0, 1), None)
    changes = {"policy": policy, "control_index": control} | changes
    return opening_sentences(replace(record, **changes))[0]  # type: ignore[arg-type]


def test_the_first_sentence_follows_the_record(record: report_data.RunRecord) -> None:
    region = "the stiffness loss of region 1"
    reached = f"; {region} reached the 60 % from which the policy leaves 3g at turn 30."
    never = f"; {region} never reached the 60 % from which the policy leaves 3g."
    assert record.truth_state is not None
    healthy = np.zeros_like(record.truth_state)
    assert flown(record, *range(30, 50)).endswith(
        "at turn 30, when the stiffness loss of region 1 had reached 60 %."
    )
    assert flown(record) == f"The twin kept 3g at every turn{reached}"
    assert flown(record, truth_state=healthy) == f"The twin kept 3g at every turn{never}"
    assert flown(record, *range(12, 50)) == f"The twin left 3g for 2g at turn 12{reached}"
    again = flown(record, 33, *range(40, 50))
    assert again.endswith(
        "; the first change came 3 turns after the stiffness loss of region 1 had reached 60 %."
    )
    # of a real asset nothing is known but what was recorded
    watched = replace(record, config={**record.config, "watched": True}, truth_state=None, first_step=1000)
    obeyed = np.tile([0.1, 0.9], (50, 1))
    obeyed[30:] = [0.8, 0.2]  # asked for 2g from turn 31 on
    left = flown(watched, *range(31, 50), decision_probability=obeyed)
    assert left == "The asset left 3g for 2g at turn 1031."
    kept = flown(watched, decision_probability=obeyed)
    assert kept == "The asset kept 3g at every turn; at 19 turns the twin had asked for another control."
    assert "truth" not in " ".join(opening_sentences(watched))
    assert flown(record, policy=None) == "The twin kept 3g at every turn."
    one = replace(record, controls=("3g",), control_index=np.zeros(50, dtype=np.int64))
    assert opening_sentences(one)[0] == "There was one control, 3g, and nothing to decide."


def test_the_last_sentence_judges_the_scatter(record: report_data.RunRecord) -> None:
    assert record.filtered.quantity is not None
    random, expected = np.random.default_rng(3), record.filtered.quantity.mean
    noise = np.full(expected.shape, 125e-6)
    known = replace(record, learnt_noise=noise, filtered=replace(
        record.filtered, quantity_standard_deviation=np.zeros_like(expected)
    ))  # fmt: skip
    draws = random.standard_normal(expected.shape)

    def last(scatter: np.ndarray) -> str:
        return opening_sentences(replace(known, observation=expected + noise * scatter))[-1]

    assert last(draws).startswith(
        "The twin's model explains the observations within the noise that it assumes: 9"
    )
    assert last(0.5 * draws).endswith("its intervals are wider than they need be.")
    assert last(2.0 * draws).endswith("the noise is larger, or the model is off.")
    draws[:, 6] += 1.4  # one gauge is off, and the others hide it
    assert "intervals, but" in last(draws)
    assert last(draws).endswith("% of those of gauge 7.")
    assert len(opening_sentences(replace(known, observation=None))) == 2


def test_what_was_learnt_and_many_states(record: report_data.RunRecord) -> None:
    course = np.tile([1.02, 0.004, 1.01, 1.03], (50, 1))
    learnt = report_data.LearntCourse("young_modulus_factor", "1", course, course[0], np.array(1.025))
    said = opening_sentences(replace(record, parameter_name=learnt.name, learnt=(learnt,)))[1]
    assert said.endswith("; it learnt the Young modulus factor: 1.020 (1.012 to 1.028, truth 1.025).")
    moments = (np.tile(part[:, :1], 6) for part in (record.filtered.mean, record.filtered.standard_deviation))
    mean, deviation = moments
    six = replace(
        record,
        state_names=tuple("abcdef"), state_titles=tuple("abcdef"), levels=record.levels[:1] * 6,
        state_units=("mm",) * 6, policy=None, truth_state=None,
        filtered=replace(record.filtered, mean=mean, standard_deviation=0.0 * deviation),
    )  # fmt: skip
    said = opening_sentences(six)[1]
    assert f"d at {mean[-1, 0]:.3g} mm (no other level is believed) and 2 other states as the figures" in said
