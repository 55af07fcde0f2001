"""Tables of labels and values on stdout."""

from collections.abc import Sequence


def print_table(lines: Sequence[tuple[str, str]]) -> None:
    width = max((len(label) for label, _ in lines), default=0)
    for label, value in lines:
        print(f"{label:<{width}}  {value}")
