"""`python -m stga_addon`, which any Python may be asked to run: it says so where it cannot."""

import sys

try:
    from .cli import main
except ModuleNotFoundError as error:
    print(f"stga: {sys.executable} lacks the package '{error.name}'", file=sys.stderr)
    raise SystemExit(2) from None

raise SystemExit(main())
