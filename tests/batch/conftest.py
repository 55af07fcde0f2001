"""What batches are compared with: the same requests, one after another in this process."""

from functools import cache

import pytest

from stga_addon.jobs.perform import perform

from .tiny import ITERATIONS, tiny_plan


@pytest.fixture(scope="session")
def trained_here(tmp_path_factory):
    """Number of seeds and iterations -> `tiny_plan` with its results, without any engine."""

    @cache
    def train(seeds, iterations):
        plan = tiny_plan(tmp_path_factory.mktemp("here"), seeds, iterations)
        for job in plan.jobs:
            perform(job.request)
        return plan

    return lambda seeds=2, iterations=ITERATIONS: train(seeds, iterations)
