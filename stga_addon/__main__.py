"""`python -m stga_addon`: the command line; says which package this Python lacks."""

import sys

try:
    from .cli.main import main
except ModuleNotFoundError as error:
    print(f"stga: {sys.executable} lacks the package '{error.name}'", file=sys.stderr)
    raise SystemExit(2) from None
except KeyboardInterrupt:
    raise SystemExit(130) from None

raise SystemExit(main())
