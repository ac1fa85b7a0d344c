"""The sentences at the head of the page."""

import html
from dataclasses import replace

import numpy as np
import pytest

from tests.twin_master.report.synthetic_run import altered
from twin_master.report.check import predictive_check
from twin_master.report.opening import opening_sentences
from twin_master.report.page import render_page
from twin_master.report.reading import Run
from twin_master.store.mission_result import LearntQuantity

REGION = "the stiffness loss of region 1"
KEPT = "The twin kept 3g at every turn"


def test_the_page_begins_with_what_was_decided_believed_and_explained(run: Run) -> None:
    decided, believed, explained = opening_sentences(run)
    assert decided == "The twin left 3g for 2g at turn 21."  # by a policy of both states
    mean, deviation = (100 * run[f"filtered/{name}"][-1, 0] for name in ("mean", "standard_deviation"))
    low, high = max(mean - 2 * deviation, 0.0), min(mean + 2 * deviation, 80.0)
    assert f"puts {REGION} at {mean:.1f} % ({low:.1f} to {high:.1f}, truth 60)" in believed
    # 150 µε of noise, 125 assumed
    assert f"{predictive_check(run).standard_deviation:.3g} times as far as it assumes" in explained
    text = html.unescape(render_page(run, {}, {})).replace("\N{NO-BREAK SPACE}", " ")
    assert " ".join(opening_sentences(run)) in " ".join(text.split())


def flown(run: Run, *gentle: int, level: float = 0.6, **changes: np.ndarray | None) -> str:
    """The first sentence of a run that flew 2g at these turns, by a policy that leaves 3g from a level on."""
    control = np.ones(50, dtype=np.int64)
    control[list(gentle)] = 0
    policy = np.where(run.model.states.coordinates[:, 0] > level - 0.01, 0, 1)
    return opening_sentences(
        altered(run, observed__control_index=control, policy__control_index=policy, **changes)
    )[0]


REACHED = f"; {REGION} reached the 60 % from which the policy leaves 3g at turn 30."


@pytest.mark.parametrize(
    ("gentle", "changes", "said"),
    [
        (range(30, 50), {}, f"The twin fell back from 3g to 2g at turn 30, when {REGION} had reached 60 %."),
        ((), {}, f"{KEPT}{REACHED}"),
        (
            (), {"truth__state": np.zeros((50, 2))},
            f"{KEPT}; {REGION} never reached the 60 % from which the policy leaves 3g.",
        ),
        (range(12, 50), {}, f"The twin left 3g for 2g at turn 12{REACHED}"),
        (
            range(31, 50), {},
            f"The twin fell back from 3g to 2g at turn 31, one turn after {REGION} had reached 60 %.",
        ),
        (
            (33, *range(40, 50)), {},
            "The twin left 3g for 2g at turn 33, left 2g for 3g at turn 34, left 3g for 2g at turn 40; "
            f"the first change came 3 turns after {REGION} had reached 60 %.",
        ),
        (
            range(1, 50), {"level": 0.0},
            "The twin left 3g for 2g at turn 1; the policy leaves 3g in every state.",
        ),
        ((), {"truth": None}, "The twin kept 3g at every turn."),
    ],
)  # fmt: skip
def test_the_first_sentence_follows_the_record(
    run: Run, gentle: tuple[int, ...], changes: dict[str, np.ndarray | None], said: str
) -> None:
    assert flown(run, *gentle, **changes) == said  # type: ignore[arg-type]


def test_of_a_real_asset_nothing_is_said_but_what_was_recorded(run: Run) -> None:
    watched = replace(altered(run, truth=None), config={**run.config, "watched": True})
    observed = watched.tree["observed"].to_dataset()
    watched.tree["observed"] = observed.assign_coords(step=observed["step"] + 1000)
    obeyed = np.tile([0.1, 0.9], (50, 1))
    obeyed[30:] = [0.8, 0.2]  # asked for 2g from turn 31 on
    left = flown(watched, *range(31, 50), filtered__decision_probability=obeyed)
    assert left == "The asset left 3g for 2g at turn 1031."
    kept = flown(watched, filtered__decision_probability=obeyed)
    assert kept == "The asset kept 3g at every turn; at 19 turns the twin had asked for another control."
    assert "truth" not in " ".join(opening_sentences(watched))


def test_the_last_sentence_judges_the_scatter(run: Run) -> None:
    random, expected, noise = np.random.default_rng(3), run["filtered/quantity_mean"], 125e-6
    known = altered(run, filtered__quantity_standard_deviation=np.zeros_like(expected))
    draws = random.standard_normal(expected.shape)

    def last(scatter: np.ndarray) -> str:
        return opening_sentences(altered(known, observed__strain=expected + noise * scatter))[-1]

    assert last(draws).startswith(
        "The twin's model explains the observations within the noise that it assumes: 9"
    )
    assert last(0.5 * draws).endswith("its intervals are wider than they need be.")
    assert last(2.0 * draws).endswith("the noise is larger, or the model is off.")
    draws[:, 6] += 1.4  # one gauge is off, and the others hide it
    assert "intervals, but" in last(draws)
    assert last(draws).endswith("% of those of gauge 7.")
    assert len(opening_sentences(altered(known, observed__strain=np.full_like(expected, np.nan)))) == 2


def test_what_was_learnt_is_said(run: Run) -> None:
    course = np.tile([1.02, 0.004, 1.01, 1.03], (50, 1))
    learnt = LearntQuantity(
        "young_modulus_factor", "Young modulus factor", "", course, course[0], np.array(1.025)
    )
    changed = replace(run)
    vars(changed)["learnt"] = (learnt,)
    said = opening_sentences(changed)[1]
    assert said.endswith("; it learnt the Young modulus factor: 1.020 (1.012 to 1.028, truth 1.025).")
