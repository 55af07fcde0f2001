"""Open Job Description: a template of a batch's jobs, for AWS Deadline Cloud or any other scheduler that reads it.

https://github.com/OpenJobDescription/openjd-specifications/wiki/2023-09-Template-Schemas
"""

from collections.abc import Sequence
from typing import Any

from ...errors import StgaError
from ...requests.folder import worker_arguments
from ...worker.launch import PACKAGES_FOLDER
from ..engine import training_python
from ..job import Job, alike
from ..plan import Plan

VERSION = "jobtemplate-2023-09"
MAX_STEPS, MAX_TASKS, MAX_NAME = 100, 1024, 64
"""Limits of the specification: steps of a template, values of a task parameter, characters of a name."""
FOLDER = "Folder"


def openjd_template(plan: Plan, jobs: Sequence[Job]) -> dict[str, Any]:
    """A template whose tasks carry out the jobs, which follow those that they come after.

    A step is a table's jobs with the same needs; it depends on steps as a whole, so that no job of it begins while one
    of those has failed. Raises StgaError where the batch has more than a template can hold.
    """
    groups = alike(jobs, MAX_TASKS)
    if len(groups) > MAX_STEPS:
        raise StgaError(f"{plan.source}: needs {len(groups)} steps of an OpenJD template, which can have {MAX_STEPS}")
    names = [f"{number} {group[0].table}"[:MAX_NAME] for number, group in enumerate(groups, 1)]
    step_of = {job.name: name for name, group in zip(names, groups, strict=True) for job in group}
    variables = {"PYTHONPATH": str(PACKAGES_FOLDER)}
    return {
        "specificationVersion": VERSION,
        "name": f"stga {plan.out.name}"[:MAX_NAME],
        "jobEnvironments": [{"name": "stga", "variables": variables}],
        "steps": [_step(name, group, step_of) for name, group in zip(names, groups, strict=True)],
    }


def _step(name: str, jobs: Sequence[Job], step_of: dict[str, str]) -> dict[str, Any]:
    needs = jobs[0].resources
    amounts = [
        {"name": "amount.worker.vcpu", "min": needs.threads or 1},
        {"name": "amount.worker.memory", "min": round(1000 * needs.memory_gb)},
        *([{"name": "amount.worker.gpu", "min": 1}] if needs.gpu else []),
    ]
    waits = dict.fromkeys(step_of[other] for job in jobs for other in job.after if other in step_of)
    folders = [str(job.request_folder) for job in jobs]
    parameter = {"name": FOLDER, "type": "STRING", "range": folders}
    arguments = worker_arguments(jobs[0].request_folder, needs.threads or None, resume=True)
    arguments = [f"{{{{Task.Param.{FOLDER}}}}}" if argument == folders[0] else argument for argument in arguments]
    return {
        "name": name,
        **({"dependencies": [{"dependsOn": other} for other in waits]} if waits else {}),
        "hostRequirements": {"amounts": amounts},
        "parameterSpace": {"taskParameterDefinitions": [parameter]},
        "script": {"actions": {"onRun": {"command": training_python(), "args": ["-m", *arguments]}}},
    }
