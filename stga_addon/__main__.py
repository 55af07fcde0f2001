"""`python -m stga_addon`, and `stga`: the command line; says which package this Python lacks."""

import os
import sys
from importlib import import_module
from importlib.util import find_spec

MAX_CAUSE_CHARACTERS = 300

# Before NumPy is loaded: its matrices are small here, and OpenBLAS's threads would wait for them in
# a loop, which takes a sixth of the processors' time.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

try:
    from .cli.main import main

    if find_spec(".development", __package__) is not None:  # not in the extension's zip
        import_module(".development.commands", __package__)  # adds its commands and requests
except ModuleNotFoundError as error:
    print(f"stga: {sys.executable} lacks the package '{error.name}'", file=sys.stderr)
    raise SystemExit(2) from None
except (ImportError, MemoryError, OSError, SystemError) as error:
    # a library that gets no memory (ulimit -v), or is damaged
    cause = " ".join(str(error).split())[:MAX_CAUSE_CHARACTERS] or type(error).__name__
    print(f"stga: {sys.executable} cannot load what it needs ({cause})", file=sys.stderr)
    raise SystemExit(2) from None
except KeyboardInterrupt:
    raise SystemExit(130) from None

if __name__ == "__main__":
    raise SystemExit(main())
