"""The evaluations of a run, read from its folder; without torch, since Blender shows them, too."""

import json
from pathlib import Path
from typing import Any

from ...errors import StgaError
from ...files import file_size

METRICS = "metrics.jsonl"


def read_metrics(folder: Path) -> list[dict[str, Any]]:
    """All complete lines, up to the first that is none: a kill may have cut it off.

    Raises StgaError where there is something else than a file, or one that cannot be read.
    """
    path = folder / METRICS
    lines: list[dict[str, Any]] = []
    if not path.exists():
        return lines
    try:
        file_size(path)
        with path.open("rb") as texts:
            for text in texts:
                line = json.loads(text.decode("utf-8"))
                if not isinstance(line, dict) or type(line.get("iteration")) is not int:
                    break
                lines.append(line)
    except OSError as error:
        raise StgaError(f"{path}: cannot be read ({error.strerror or error})") from error
    except (ValueError, RecursionError):
        pass
    return lines
