"""How long the fuzz targets run: a few dozen examples each, or STGA_FUZZ_SECONDS in all."""

import os

from hypothesis import HealthCheck, settings

# Hypothesis counts examples, not seconds: a bounded run repeats the profile with other seeds until
# its time is up.
SECONDS = float(os.environ.get("STGA_FUZZ_SECONDS", 0))
QUIET = {
    "deadline": None,
    "database": None,
    "suppress_health_check": [
        HealthCheck.too_slow,
        HealthCheck.function_scoped_fixture,
        HealthCheck.data_too_large,
    ],
}

settings.register_profile("stga-quick", max_examples=40, derandomize=True, **QUIET)
settings.register_profile("stga-fuzz", max_examples=100, **QUIET)
