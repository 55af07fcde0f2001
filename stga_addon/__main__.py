"""`python -m stga_addon`: the command line, which says in one sentence where this Python lacks a
package."""

import sys

try:
    from .cli.main import main
except ModuleNotFoundError as error:
    print(f"stga: {sys.executable} lacks the package '{error.name}'", file=sys.stderr)
    raise SystemExit(2) from None
except KeyboardInterrupt:
    raise SystemExit(130) from None

raise SystemExit(main())
