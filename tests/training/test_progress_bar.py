"""The progress bar of a run on a terminal."""

import logging

import pytest

from stga_addon.training.run.progress import Progress
from stga_addon.training.run.progress_bar import ProgressBar


def test_messages_have_lines_of_their_own(capsys: pytest.CaptureFixture[str]) -> None:
    """Catches a warning glued to the end of the bar, as where a GPU fails and training goes on on the CPU."""
    with ProgressBar() as bar:
        bar.report(Progress(share=0.5, iteration=3, message="Training"))
        logging.getLogger("stga_addon").warning("the GPU failed")
        bar.report(Progress(share=0.6, iteration=4, message="Training"))
    written = capsys.readouterr()
    text = (written.err + written.out).replace("\r", "\n")
    assert "the GPU failed" in [line.strip() for line in text.splitlines()]


def test_a_fitted_psnr_is_called_so(capsys: pytest.CaptureFixture[str]) -> None:
    """Catches a PSNR with fitted exposure that a person takes for the other one."""
    with ProgressBar() as bar:
        bar.report(Progress(share=0.0, iteration=3, psnr=31.0, psnr_unmatched=25.0))
        bar.report(Progress(share=1.0, iteration=4, psnr=31.0, psnr_unmatched=25.0))
    assert "PSNR 31.00 (exposure fitted; 25.00 without)" in capsys.readouterr().err
