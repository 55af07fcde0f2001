"""Progress bar of a training run on a terminal."""

import math
from contextlib import ExitStack

from tqdm import tqdm
from tqdm.contrib.logging import logging_redirect_tqdm

from .progress import Progress


class ProgressBar:
    """tqdm over the share of the budget, with speed, loss, PSNR and forecast beside it. What is logged goes above."""

    def __enter__(self) -> "ProgressBar":
        layout = "{desc}{percentage:3.0f}%|{bar}| {elapsed}<{remaining}{postfix}"
        self._bar = tqdm(total=1.0, bar_format=layout, mininterval=0.5, dynamic_ncols=True)
        self._opened = ExitStack()
        self._opened.callback(self._bar.close)
        self._opened.enter_context(logging_redirect_tqdm())
        return self

    def __exit__(self, *_: object) -> None:
        self._opened.close()

    def report(self, progress: Progress) -> bool:
        self._bar.set_description(progress.message, refresh=bool(progress.iteration == 0))
        psnr = "" if progress.psnr is None else f", PSNR {progress.psnr:.2f}"
        if progress.psnr_unmatched is not None:
            psnr += f" (exposure fitted; {progress.psnr_unmatched:.2f} without)"
        if progress.iteration:
            loss = "" if math.isnan(progress.loss) else f", loss {progress.loss:.4f}"  # local iterations have none
            figures = f"{progress.per_second:.1f} it/s{loss}{psnr}, {progress.splats} splats"
            forecast_text = f"; {progress.forecast_text}" if progress.forecast_text else ""
            self._bar.set_postfix_str(figures + forecast_text, refresh=False)
        self._bar.update(progress.share - self._bar.n)
        return False
