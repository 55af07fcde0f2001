"""TrainingSettings survive their trip through JSON and refuse what cannot be."""

import dataclasses
import json
from typing import Any

import pytest

from stga_addon.errors import StgaError
from stga_addon.selection import SelectionOptions
from stga_addon.training.settings import (
    SCHEDULES,
    STRATEGIES,
    Rates,
    TrainingSettings,
    from_json,
    make_settings,
    to_json,
)


@pytest.mark.parametrize("strategy", STRATEGIES)
@pytest.mark.parametrize("schedule", SCHEDULES)
def test_json_round_trip(strategy: str, schedule: str) -> None:
    """Catches a field that changes its value or kind (a tuple into a list) in run.json, so a resumed run differs."""
    settings = make_settings(strategy, schedule, seconds=90.5, background=(0.0, 0.5, 1.0), seed=7)
    again = from_json(json.loads(json.dumps(to_json(settings))))
    assert again == settings
    assert [type(v) for v in vars(again).values()] == [type(v) for v in vars(settings).values()]


def test_nested_settings_round_trip() -> None:
    """Catches nested settings that come back with their defaults."""
    chosen = SelectionOptions(threshold=0.5, zero_pose="all", regions=("nose",))
    settings = make_settings(iterations=5, selection=chosen, rates=Rates(xyz=1.0))
    assert from_json(json.loads(json.dumps(to_json(settings)))) == settings


@pytest.mark.parametrize("change", [{"colour": 1}, {"rates": {"xyz": 1, "abc": 2}}, {"selection": {}}, {"rates": None}])
def test_unknown_or_missing_fields(change: dict[str, Any]) -> None:
    """Catches a misspelt field that is dropped in silence."""
    with pytest.raises((TypeError, KeyError)):
        from_json({**to_json(TrainingSettings(iterations=5)), **change})


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"strategy": "best", "iterations": 5}, "--strategy: 'best' is not one of selective, global"),
        ({"schedule": "fast", "iterations": 5}, "--schedule: 'fast' is not one of default, paper"),
        ({}, "one of the two"),
        ({"seconds": 5.0, "iterations": 5}, "one of the two"),
        ({"seconds": 0.0}, "more than nothing"),
        ({"iterations": 0}, "more than nothing"),
        ({"iterations": -3}, "more than nothing"),
        ({"seconds": float("nan")}, "more than nothing"),
    ],
)
def test_impossible_settings(arguments: dict[str, Any], message: str) -> None:
    """Catches a budget of nothing or of two kinds, and names that are not known."""
    with pytest.raises(StgaError, match=message):
        make_settings(**arguments)


def test_the_papers_letter() -> None:
    """Catches a schedule that does not reach the settings: the figures are the paper's own."""
    paper = make_settings(schedule="paper", iterations=5)
    assert (paper.global_interval, paper.global_unit, paper.warm_up_share) == (20, "iteration", 0.0)
    assert (paper.lattice, paper.views_per_visit, paper.hull_points) == (4, 0, False)
    assert (paper.scale_limit, paper.stray_limit, paper.selection.threshold) == (1.0, 1.0, 0.01)
    changed = make_settings(schedule="paper", iterations=5, lattice=2)
    assert changed == dataclasses.replace(paper, lattice=2)
