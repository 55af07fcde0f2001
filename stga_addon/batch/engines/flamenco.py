"""Flamenco: a job type of one JavaScript file that holds the jobs of a batch, for the manager's `scripts` folder.

https://flamenco.blender.org/usage/job-types/: the manager reads JOB_TYPE and calls compileJob.
"""

import json
from collections.abc import Sequence

from ...requests.values import RenderBlend
from ...worker.launch import PACKAGES_FOLDER
from ..engine import job_command
from ..job import Job
from ..plan import Plan

TEMPLATE = """// A batch of stga as a job type of Flamenco 3: put this file into the manager's `scripts` folder,
// and submit a job of this type. Each task continues what it began before.
// Resources are not part of a job type: use worker tags.
const BATCH = %s;

const JOB_TYPE = {
  label: "STGA batch " + BATCH.name,
  settings: [],
};

function compileJob(job) {
  const tasks = {};
  for (const each of BATCH.jobs) {
    const task = author.Task(each.name, each.type);
    task.addCommand(author.Command("exec", { exe: "env", args: ["PYTHONPATH=" + BATCH.packages, ...each.command] }));
    for (const other of each.after) {
      task.addDependency(tasks[other]);
    }
    tasks[each.name] = task;
    job.addTask(task);
  }
}
"""


def flamenco_job_type(plan: Plan, jobs: Sequence[Job]) -> str:
    """The JavaScript of the jobs, which follow those that they come after."""
    names = {job.name for job in jobs}
    listed = [
        {
            "name": job.name,
            "type": "blender" if isinstance(job.request, RenderBlend) else "misc",  # which workers take it
            "after": [other for other in job.after if other in names],
            "command": job_command(job),
        }
        for job in jobs
    ]
    batch = {"name": plan.out.name, "packages": str(PACKAGES_FOLDER), "jobs": listed}
    return TEMPLATE % json.dumps(batch, indent=1)
