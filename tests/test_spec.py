"""What a model file says about itself."""

from __future__ import annotations

import dataclasses
import json
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from psiamfcpp import UserError
from psiamfcpp.models.siamfcpp_alexnet import ARCHITECTURE
from psiamfcpp.spec import (
    FORMAT,
    Calibration,
    ModelSpec,
    TrackingConstants,
)


@pytest.mark.parametrize(("side", "expected"), [(127, 6), (303, 28), (239, 20)])
def test_feature_size(side: int, expected: int) -> None:
    assert ARCHITECTURE.feature_size(side) == expected


@pytest.mark.parametrize(("search_size", "cells"), [(303, 17), (239, 9), (247, 10), (271, 13), (191, 3), (367, 25)])
def test_score_map_and_its_first_cell(search_size: int, cells: int) -> None:
    assert ARCHITECTURE.score_size(search_size) == cells
    # whatever the size, cell 0 stands at 87, and the last one as far from the other edge
    assert ARCHITECTURE.first_cell(search_size) == 87
    assert search_size - 1 - (87 + 8 * (cells - 1)) == 87


@pytest.mark.parametrize("search_size", [0, -1, 100, 127, 175, 183, 300, 302, 304])
def test_sizes_without_a_map_are_refused(search_size: int) -> None:
    with pytest.raises(UserError, match=f"search size {search_size} .*try 239 or 303"):
        ARCHITECTURE.score_size(search_size)
    with pytest.raises(UserError, match="search size"):
        ModelSpec(search_size=search_size)


numbers = st.floats(allow_nan=False, allow_infinity=False)


@given(
    st.fixed_dictionaries({name: st.integers(1, 2000) for name in ARCHITECTURE.groups}),
    st.sampled_from([239, 303]),
    st.builds(TrackingConstants, numbers, numbers, numbers),
    st.builds(Calibration, *[numbers] * 6),
    st.dictionaries(st.text(), st.none() | st.text() | st.lists(st.integers())),
)
def test_json_keeps_everything(
    widths: dict[str, int], search: int, constants: TrackingConstants, calibration: Calibration, made: dict[str, Any]
) -> None:
    spec = ModelSpec(widths, 127, search, constants, calibration, made)
    text = spec.to_json()
    assert ModelSpec.from_json(text) == spec
    assert json.loads(text)["format"] == FORMAT == "psiamfcpp-model/1"


def test_defaults_are_the_unpruned_network_of_the_authors() -> None:
    spec = ModelSpec.from_json(json.dumps({"format": FORMAT}))
    assert spec == ModelSpec()
    assert (spec.template_size, spec.search_size, len(spec.widths)) == (127, 303, 13)
    assert dataclasses.astuple(spec.constants) == (0.5249642198880932, 0.23153228172839774, 0.05413758904760692)


def described(**changes: Any) -> str:
    return json.dumps({**json.loads(ModelSpec().to_json()), **changes})


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "not JSON"),
        (ModelSpec().to_json()[:-20], "not JSON"),
        ("[1, 2]", "is not psiamfcpp-model/1"),
        ("{}", "is not psiamfcpp-model/1"),
        (described(format="psiamfcpp-model/2"), "is not psiamfcpp-model/1"),
        (described(serch_size=303), "unknown key 'serch_size' in ModelSpec: did you mean 'search_size'"),
        (described(constants={"test_rl": 0.5}), "'test_rl' in TrackingConstants: did you mean 'test_lr'"),
        (described(calibration={"zzz": 1}), "unknown key 'zzz' in Calibration; known are bias, score_weight"),
        (described(constants=[1, 2, 3]), "TrackingConstants in the model description is not an object"),
        (described(calibration=7), "Calibration in the model description is not an object"),
        (described(search_size="303"), "search_size in ModelSpec is '303', which is no such value"),
        (described(search_size=303.0), "search_size in ModelSpec is 303.0"),
        (described(constants={"test_lr": "fast"}), "test_lr in TrackingConstants is 'fast'"),
        (described(constants={"test_lr": None}), "test_lr in TrackingConstants is None"),
        (described(calibration={"bias": float("nan")}), "bias in Calibration is nan"),
        (described(search_size=300), "search size 300"),
        (described(widths=7), "damaged"),
    ],
)
def test_foreign_and_damaged_descriptions_are_refused(text: str, message: str) -> None:
    with pytest.raises(UserError, match=message):
        ModelSpec.from_json(text)


def without(name: str) -> dict[str, int]:
    return {key: value for key, value in ARCHITECTURE.groups.items() if key != name}


@pytest.mark.parametrize(
    ("widths", "message"),
    [
        (without("neck.cls"), r"missing \['neck.cls'\], unknown \[\]"),
        ({**ARCHITECTURE.groups, "neck.cla": 3}, r"missing \[\], unknown \['neck.cla'\]"),
        ({}, "13 groups"),
        ({**ARCHITECTURE.groups, "head.reg2": 0}, "width of head.reg2 is 0"),
        ({**ARCHITECTURE.groups, "head.reg2": -5}, "width of head.reg2 is -5"),
        ({**ARCHITECTURE.groups, "head.reg2": 1.5}, "width of head.reg2 is 1.5"),
        ({**ARCHITECTURE.groups, "head.reg2": "8"}, "width of head.reg2 is '8'"),
    ],
)
def test_widths_name_the_thirteen_groups(widths: dict[str, int], message: str) -> None:
    with pytest.raises(UserError, match=message):
        ModelSpec(widths=widths)
    with pytest.raises(UserError, match=message):
        ModelSpec.from_json(described(widths=widths))


def test_two_specs_do_not_share_their_widths() -> None:
    ModelSpec().widths["neck.cls"] = 1
    assert ModelSpec().widths["neck.cls"] == ARCHITECTURE.groups["neck.cls"] == 256


def test_a_model_may_have_no_calibration() -> None:
    spec = ModelSpec(calibration=None)
    assert json.loads(spec.to_json())["calibration"] is None
    assert ModelSpec.from_json(spec.to_json()) == spec
    # one that says nothing about it, as those of version 0.1 may, has the default
    without = {key: value for key, value in json.loads(spec.to_json()).items() if key != "calibration"}
    assert ModelSpec.from_json(json.dumps(without)) == ModelSpec()


def test_sizes_and_widths_are_those_of_the_architecture() -> None:
    spec = ModelSpec(architecture="lightfc")
    assert (spec.widths, spec.template_size, spec.search_size) == (spec.arch.groups, 128, 256)
    assert ModelSpec.from_json(spec.to_json()) == spec
    assert (ModelSpec().template_size, ModelSpec().search_size) == (127, 303)
