"""`python -m stga_addon`, which any Python may be asked to run: it says so where it cannot.

With STGA_HEAD set, the command is about the head that `handover` wrote into that folder.
"""

import os
import sys
from pathlib import Path

try:
    from .cli.main import main
    from .errors import StgaError
    from .jobs.delegate import FOLDER, read_head
except ModuleNotFoundError as error:
    print(f"stga: {sys.executable} lacks the package '{error.name}'", file=sys.stderr)
    raise SystemExit(2) from None

folder = os.environ.get(FOLDER)
try:
    head = read_head(Path(folder)) if folder else None
except StgaError as error:
    print(f"stga: {error}", file=sys.stderr)
    raise SystemExit(2) from None
raise SystemExit(main(head=head))
