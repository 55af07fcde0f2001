"""Carrying out a request on the command line: progress on a terminal, and what there is to say."""

import sys
from contextlib import ExitStack
from typing import TYPE_CHECKING, Any

from ..format import describe_figures
from ..jobs.results import Result
from ..jobs.table import Request
from ..progress import Progress, ignore

if TYPE_CHECKING:
    from tqdm import tqdm

LAYOUT = "{desc}{percentage:3.0f}%|{bar}| {elapsed}{postfix}"
LAYOUT_WITH_TIME_LEFT = LAYOUT.replace("{elapsed}", "{elapsed}<{remaining}")


def carry_out(request: Request, with_bar: bool = True) -> Result:
    """Carry out the request with a progress bar, and print what it says; raises as `perform`."""
    from ..jobs.perform import perform

    with ProgressBar() as bar:
        result = perform(request, bar.report if with_bar else ignore, bar.say)
    for line in getattr(result, "lines", ()):
        print(line)
    return result


class ProgressBar:
    """A bar on stderr with stage and figures; what is said or logged goes above it."""

    def __enter__(self) -> "ProgressBar":
        self._bar: tqdm[Any] | None = None
        self._stage = ""
        self._opened = ExitStack()
        return self

    def __exit__(self, *_: object) -> None:
        if self._bar is not None:
            # a bar of work that failed before it began would stand above the reason
            self._bar.leave = self._bar.n > 0
        self._opened.close()

    def report(self, progress: Progress) -> bool:
        if self._bar is None:
            from tqdm import tqdm
            from tqdm.contrib.logging import logging_redirect_tqdm

            bar = tqdm(total=1.0, bar_format=LAYOUT, mininterval=0.5, dynamic_ncols=True)
            self._bar = self._opened.enter_context(bar)
            self._opened.enter_context(logging_redirect_tqdm())
        self._bar.set_description(progress.stage, refresh=progress.stage != self._stage)
        self._stage = progress.stage
        figures = progress.figures()
        self._bar.bar_format = LAYOUT if "left_s" in figures else LAYOUT_WITH_TIME_LEFT
        told = [*describe_figures(figures), progress.detail]
        self._bar.set_postfix_str("; ".join(filter(None, told)), refresh=False)
        self._bar.update(progress.share - self._bar.n)
        return False

    def say(self, line: str) -> None:
        """Print a line above the bar."""
        if self._bar is None:
            print(line)
            return
        self._bar.clear()
        print(line, flush=True)
        sys.stderr.flush()
