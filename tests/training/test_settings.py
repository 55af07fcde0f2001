"""TrainingSettings survive their trip through JSON and refuse what cannot be."""

import dataclasses

import pytest
from refusal import refusal

from stga_addon.capture.selection import SelectionOptions
from stga_addon.schema import from_json, to_json
from stga_addon.training.settings import Rates, TrainingSettings, make_settings


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"strategy": "best"}, "setting strategy: expected one of global, selective"),
        ({"schedule": "fast"}, "setting schedule: expected one of default, paper"),
        ({"preset": "best"}, "setting preset: expected one of draft, standard, final, got 'best'"),
        ({"preset": []}, "setting preset: "),
        ({"iterations": None}, "either in seconds or in iterations"),
        ({"seconds": 5.0}, "either in seconds or in iterations"),
        ({"iterations": -3}, "iterations: expected a whole number from 1 up to 2147483647, got -3"),
        ({"effects": {"jaw": "on"}, "schedule": "paper"}, "cannot be combined with --schedule"),
    ],
)
def test_impossible_settings(arguments, message):
    """Catches a budget of two kinds, unknown names, and settings at odds with each other."""
    with refusal(message):
        make_settings(**{"iterations": 5, **arguments})


REFUSED = {
    "seconds": (0.0,),
    "iterations": (0, 1 << 31),
    **dict.fromkeys(("scale_limit", "growth", "ema_share"), (10**7,)),
    "seed": (-1, 1 << 63),
    "lattice": (17,),
    "sh_degree": (4, -1),
    "sh_steps": ((-1.0,),),
    "density_span": ((0.1,), (0.1, -1.0)),
    "background": ((2.0, 0.0, 0.0), "white"),
    "exposure": (((0.0, 1.0),), ((0.0, 0.0, 1.0, 1.0, 0.0, 0.0, 0.0),)),
    "target_psnr": (0.0, 201.0),
    "effects": ({"jaw": "maybe"}, {"chin": "on"}),
    "hull_points": (1,),
    "rates": (Rates(end=-1.0),),
    "selection": (SelectionOptions(regions=("nose", 5)),),
    "scale": (2.0, 0.01),
    **dict.fromkeys(("convention", "global_unit"), ("x",)),
    **dict.fromkeys(("density_interval", "stray_reset_interval"), (-1,)),
    "global_interval": (0,),
    **dict.fromkeys(("warm_up_share", "ssim_weight"), (1.5,)),
    "distance_weight": (10**30,),
}
"""Values beyond each setting's own limits; what no number, tuple or text is, `tests/test_schema.py`
has."""


@pytest.mark.parametrize(
    ("name", "value"), [(name, value) for name, values in REFUSED.items() for value in values]
)
def test_one_schema_for_new_and_stored_settings(name, value):
    """Catches a setting whose run cannot be read again, or a stored one that breaks it."""
    budget = {} if name == "seconds" else {"iterations": 5}
    with refusal(f"^setting {name}") as caught:
        make_settings(**{**budget, name: value})
    assert len(str(caught.value)) < 400
    stored = {**to_json(make_settings(iterations=5)), "iterations": budget.get("iterations")}
    plain = dataclasses.asdict(value) if dataclasses.is_dataclass(value) else value
    with refusal(name):
        from_json(TrainingSettings, {**stored, name: plain})
