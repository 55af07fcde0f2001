"""A batch of trainings that take a moment each."""

from pathlib import Path
from typing import Any

from capture.factory import write_mesh_capture

from stga_addon.avatar.file import read_avatar
from stga_addon.batch.plan import Plan, make_plan
from stga_addon.files import read_npz
from stga_addon.training.run.folder import AVATAR

SETTINGS = {"strategy": "selective", "iterations": 40, "hull_points": False}


def tiny_plan(base: Path, seeds: int = 2, **settings: Any) -> Plan:
    """Trainings of one capture with several seeds, and an evaluation after each; results into `base`/runs."""
    if not (base / "capture").exists():
        write_mesh_capture(base / "capture", (0, 1, 3, 4), range(4))
    train = {
        "request": "train",
        "capture": "capture",
        "principal_point": "opencv",
        "device": "cpu",
        "settings": {**SETTINGS, **settings},
        "sweep": {"settings.seed": list(range(seeds))},
        "minutes": 0.1,
    }
    tables = {"train": train, "evaluate": {"request": "evaluate", "run": "{train}", "minutes": 0.1}}
    resources = {"threads": 1, "memory_gb": 0.5}
    return make_plan({"out": "runs", "resources": resources, "job": tables}, base, "plan")


def splats_of(plan: Plan, name: str) -> dict[str, bytes]:
    """The arrays of a run's avatar as bytes."""
    path = plan.out / name / AVATAR
    read_avatar(path)
    return {key: array.tobytes() for key, array in read_npz(path).items()}
