"""The progress bar on a terminal."""

import logging

import pytest

from stga_addon.cli.commands import ProgressBar
from stga_addon.progress import Progress


def test_messages_have_lines_of_their_own(capsys: pytest.CaptureFixture[str]) -> None:
    """Catches a sentence glued to the end of the bar, as where a GPU fails and training goes on on
    the CPU."""
    with ProgressBar() as bar:
        bar.report(Progress(0.5, "Training"))
        logging.getLogger("stga_addon").warning("the GPU failed")
        bar.say("a warning")
        bar.report(Progress(0.6, "Training"))
    written = capsys.readouterr()
    lines = [
        line.strip() for line in (written.err + "\n" + written.out).replace("\r", "\n").splitlines()
    ]
    assert "the GPU failed" in lines
    assert "a warning" in lines


def test_a_fitted_psnr_is_called_so(capsys: pytest.CaptureFixture[str]) -> None:
    """Catches a PSNR with fitted exposure that a person takes for the other one."""
    figures = {"iteration": 3.0, "psnr": 31.0, "psnr_unmatched": 25.0}
    with ProgressBar() as bar:
        bar.report(Progress(0.0, figures=lambda: figures))
        bar.report(Progress(1.0, figures=lambda: figures))
    assert "PSNR 31.00 dB (exposure fitted)   25.00 dB without" in capsys.readouterr().err


def test_time_left_is_said_once(capsys: pytest.CaptureFixture[str]) -> None:
    """Catches the bar's own guess beside the time left that the work says."""
    for figures, guesses in (({"left_s": 31.0}, False), ({}, True)):
        with ProgressBar() as bar:
            bar.report(Progress(0.5, "Landmarks", figures=lambda figures=figures: figures))
        written = capsys.readouterr().err
        assert ("31 s left" in written, "<" in written) == (not guesses, guesses)
