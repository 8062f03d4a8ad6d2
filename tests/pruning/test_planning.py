"""Plans from tables, and the files of both."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from psiamfcpp.errors import UserError
from psiamfcpp.models.siamfcpp_alexnet import ARCHITECTURE, PAPER_KEEP
from psiamfcpp.pruning import Plan, RankTable, plan
from psiamfcpp.pruning.planning import plan_for_budget, rows
from psiamfcpp.pruning.table import GroupRanks

PAPER_WIDTHS = {
    "backbone.conv1": 76,
    "backbone.conv2": 224,
    "backbone.conv3": 337,
    "backbone.conv4": 334,
    "backbone.conv5": 256,
    "neck.cls": 256,
    "neck.reg": 256,
    "head.cls1": 230,
    "head.cls2": 138,
    "head.cls3": 224,
    "head.reg1": 227,
    "head.reg2": 145,
    "head.reg3": 224,
}


def table(parts: int = 1, norm: list[float] | None = None, **groups: list[float]) -> RankTable:
    return RankTable(
        10,
        {
            name: GroupRanks(np.array(rank), 10, None if norm is None else np.array(norm), parts)
            for name, rank in groups.items()
        },
    )


MakeTable = Callable[..., RankTable]


def test_the_papers_shares_give_the_papers_widths(make_table: MakeTable) -> None:
    assert plan(make_table(), keep=PAPER_KEEP).widths == PAPER_WIDTHS


def test_thresholds_that_lie_between_ranks_give_the_same_plan_as_shares(make_table: MakeTable) -> None:
    # Ranks of a group are 0.5, 1.5, ... so that width - kept is a rank between the last that goes and the first kept.
    ranks = make_table()
    limits = {
        name: float(ARCHITECTURE.groups[name] - kept)
        for name, kept in PAPER_WIDTHS.items()
        if kept < ARCHITECTURE.groups[name]
    }
    assert plan(ranks, threshold=limits) == plan(ranks, keep=PAPER_KEEP)
    assert plan(ranks, threshold=limits).widths == PAPER_WIDTHS


def test_the_highest_ranks_stay_in_their_original_order() -> None:
    assert plan(table(a=[3, 9, 1, 7], b=[1, 2]), keep={"a": 0.5}).keep == {"a": [1, 3], "b": [0, 1]}


def test_of_equal_filters_the_first_stay() -> None:
    assert plan(table(a=[0, 5, 0, 0, 0]), keep={"a": 0.6}).keep["a"] == [0, 1, 2]


def test_a_threshold_keeps_what_lies_above_it_and_not_what_equals_it() -> None:
    assert plan(table(a=[0, 4, 4.5, 0, 9]), threshold={"a": 4}).keep["a"] == [2, 4]
    assert plan(table(a=[0, 4, 4.5, 0, 9]), threshold={"a": 0}).keep["a"] == [1, 2, 4]


def test_in_flat_groups_the_dead_go_first_and_then_the_smallest_weights() -> None:
    flat = table(a=[8, 8.01, 0, 8, 8], norm=[3, 1, 9, 4, 2])
    assert flat.groups["a"].flat and flat.groups["a"].dead == 1
    assert plan(flat, keep={"a": 0.8}).keep["a"] == [0, 1, 3, 4]
    assert plan(flat, keep={"a": 0.4}).keep["a"] == [0, 3]


@pytest.mark.parametrize(
    ("rank", "flat"),
    [
        ([27.99, 28, 27.98, 28], True),
        ([28, 28, 27], False),
        ([0, 0, 0], True),
        ([0, 0, 5, 5], True),
        # One stray filter of fifty is no order; some of twenty are.
        ([28.0] * 49 + [3], True),
        ([28.0] * 18 + [3, 4], False),
    ],
)
def test_flat(rank: list[float], flat: bool) -> None:
    assert table(a=rank).groups["a"].flat is flat


def test_parts_of_a_grouped_convolution_keep_the_same_positions() -> None:
    # Means of positions 0..2 over both parts: 4, 5, 3.
    chosen = plan(table(parts=2, a=[7, 5, 1, 1, 5, 5]), keep={"a": 1 / 3})
    assert chosen.keep["a"] == [1, 4]
    with pytest.raises(UserError, match="multiple of 2"):
        plan(table(parts=2, a=[7, 5, 1, 1, 5, 5]), keep={"a": 0.5})


@given(st.integers(1, 400), st.floats(0.01, 1))
def test_the_count_is_the_nearest_to_the_share(width: int, share: float) -> None:
    ranks = table(a=list(range(1, width + 1)))
    if share * width < 0.49:
        with pytest.raises(UserError, match="leaves none"):
            plan(ranks, keep={"a": share})
    elif share * width > 0.51:
        assert abs(plan(ranks, keep={"a": share}).widths["a"] - share * width) <= 0.5 + 1e-9


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"keep": {"a": 0}}, "share of a to keep is 0"),
        ({"keep": {"a": 1.5}}, "share of a to keep is 1.5"),
        ({"keep": {"a": -0.5}}, "must lie above 0"),
        ({"keep": {"a": float("nan")}}, "share of a to keep is nan"),
        ({"keep": {"a": 0.01}}, "leaves none"),
        ({"keep": {"z": 0.5}}, "no group 'z'"),
        ({"threshold": {"z": 0.5}}, "no group 'z'"),
        ({"threshold": {"a": 9}}, "no filter of a has a rank above 9"),
        ({"keep": {"a": 0.5}, "threshold": {"a": 1}}, "both"),
        ({"keep": {"b": 0.5}}, "b are flat"),
    ],
)
def test_refused_plans(options: dict[str, Any], message: str) -> None:
    with pytest.raises(UserError, match=message):
        plan(table(a=[1, 5, 9], b=[4, 4, 4]), **options)


def macs(widths: Mapping[str, int]) -> int:
    """Of two layers, the second of which reads the first."""
    return 10 * widths["a"] + widths["a"] * widths["b"]


def test_a_budget_is_met_by_the_filters_that_say_least() -> None:
    ranks = table(a=[9, 9, 1, 9], b=[9, 1, 1, 8], c=[5, 5, 5, 5], norm=[1, 2, 3, 4])
    full = macs(ranks.widths)
    chosen = plan_for_budget(ranks, macs, 0.7 * full)
    assert macs(chosen.widths) <= 0.7 * full
    assert 2 not in chosen.keep["a"]
    assert len(chosen.keep["c"]) == 4
    assert plan_for_budget(ranks, macs, full).widths == ranks.widths


def test_a_budget_that_only_flat_groups_could_meet() -> None:
    ranks = table(a=[9, 9, 1, 9], c=[5, 5, 5, 5], norm=[1, 2, 3, 4])
    with pytest.raises(UserError, match=r"cannot be met.*flat"):
        plan_for_budget(ranks, lambda widths: widths["c"], 2)
    assert plan_for_budget(ranks, lambda widths: widths["c"], 2, flat_too=True).keep["c"] == [2, 3]
    with pytest.raises(UserError, match="cannot be met: 1 is the least"):
        plan_for_budget(ranks, lambda widths: widths["c"], 0.5, flat_too=True)


def test_rows_of_a_plan() -> None:
    ranks = table(a=[0, 7, 3, 9], b=[4, 4, 4, 4])
    assert rows(ranks, plan(ranks, keep={"a": 0.5})) == [
        {"group": "a", "kept": 2, "removed": 2, "cut": 3.0, "dead": 1, "flat": False},
        {"group": "b", "kept": 4, "removed": 0, "cut": None, "dead": 0, "flat": True},
    ]


def test_plans_survive_their_file(tmp_path: Path) -> None:
    path = tmp_path / "plan.json"
    Plan({"a": [3, 0, 2], "b": [1]}).write(path)
    assert json.loads(path.read_text()) == {"format": "psiamfcpp-plan/1", "keep": {"a": [0, 2, 3], "b": [1]}}
    assert Plan.read(path) == Plan({"a": [0, 2, 3], "b": [1]})
    assert list(tmp_path.iterdir()) == [path]


def test_tables_survive_their_file(tmp_path: Path, make_table: MakeTable) -> None:
    path, ranks = tmp_path / "ranks.json", make_table()
    ranks.write(path)
    read = RankTable.read(path)
    assert (read.images, read.widths) == (100, ARCHITECTURE.groups)
    for name, group in ranks.groups.items():
        assert read.groups[name].rank == pytest.approx(group.rank, abs=1e-6)
        assert read.groups[name].norm == pytest.approx(group.norm, abs=1e-6)
        assert (read.groups[name].flat, read.groups[name].max) == (group.flat, group.max)


def test_a_table_needs_nothing_but_ranks(tmp_path: Path) -> None:
    path = tmp_path / "ranks.json"
    path.write_text('{"format": "psiamfcpp-ranks/1", "images": 5, "groups": {"a": {"rank": [1, 2.5], "max": 73}}}')
    assert RankTable.read(path).groups["a"].rank.tolist() == [1, 2.5]


def damaged(**group: Any) -> str:
    return json.dumps({"format": "psiamfcpp-ranks/1", "images": 5, "groups": {"a": {"rank": [1, 2], **group}}})


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "not JSON"),
        (damaged()[:-9], "not JSON"),
        ("[]", "is not psiamfcpp-ranks/1"),
        ('{"format": "psiamfcpp-plan/1"}', "is not psiamfcpp-ranks/1"),
        ('{"format": "psiamfcpp-ranks/1", "images": 5}', "no groups"),
        ('{"format": "psiamfcpp-ranks/1", "images": 5, "groups": {}}', "no groups"),
        ('{"format": "psiamfcpp-ranks/1", "groups": {"a": {"rank": [1]}}}', "of None images"),
        ('{"format": "psiamfcpp-ranks/1", "images": 5, "groups": {"a": [1]}}', "a in rank table"),
        (damaged(rank=[1, float("nan")]), "nan at filter 1"),
        (damaged(rank=[1, float("inf")]), "inf at filter 1"),
        (damaged(rank=[-1, 1]), "-1 at filter 0"),
        (damaged(rank=[1, None]), "None at filter 1"),
        (damaged(rank=[1, True]), "True at filter 1"),
        (damaged(rank=[]), "no list of numbers"),
        (damaged(rank="12"), "no list of numbers"),
        (damaged(norm=[1]), "2 ranks but 1 norms"),
        (damaged(max="x"), "max of a"),
        (damaged(parts=3), "parts 3"),
    ],
)
def test_damaged_tables_are_refused(tmp_path: Path, text: str, message: str) -> None:
    path = tmp_path / "ranks.json"
    path.write_text(text)
    with pytest.raises(UserError, match=message) as refused:
        RankTable.read(path)
    assert str(path) in str(refused.value)


@pytest.mark.parametrize(
    ("keep", "message"),
    [
        ({"a": []}, "prunes a to zero"),
        ({"a": [0, 1, 1]}, "filter 1 of a twice"),
        ({"a": [-1, 0]}, "filter -1 of a"),
        ({"a": [0.5]}, "filter 0.5 of a"),
        ({"a": ["0"]}, "filter '0' of a"),
        ({"a": [True]}, "filter True of a"),
        ({"a": 3}, "no lists"),
        ({}, "no lists"),
        (None, "no lists"),
    ],
)
def test_damaged_plans_are_refused(tmp_path: Path, keep: Any, message: str) -> None:
    path = tmp_path / "plan.json"
    path.write_text(json.dumps({"format": "psiamfcpp-plan/1", "keep": keep}))
    with pytest.raises(UserError, match=message) as refused:
        Plan.read(path)
    assert str(path) in str(refused.value)


def test_a_plan_for_another_network_is_refused() -> None:
    Plan({"a": [0, 3]}).check({"a": 4, "b": 2})
    with pytest.raises(UserError, match="filter 3 of a, which has 3"):
        Plan({"a": [0, 3]}).check({"a": 3})
    with pytest.raises(UserError, match="names c"):
        Plan({"c": [0]}).check({"a": 3})


def test_files_that_cannot_be_read_or_written_are_refused(tmp_path: Path) -> None:
    for read in (Plan.read, RankTable.read):
        with pytest.raises(UserError, match="does not exist"):
            read(tmp_path / "absent.json")
    with pytest.raises(UserError, match="cannot be written"):
        Plan({"a": [0]}).write(tmp_path)
