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
    lines = (written.err + "\n" + written.out).replace("\r", "\n").splitlines()
    assert {"the GPU failed", "a warning"} <= {line.strip() for line in lines}


@pytest.mark.parametrize(
    ("figures", "shown", "guesses"),
    [
        (
            {"psnr": 31.0, "psnr_unmatched": 25.0},
            "PSNR 31.00 dB (exposure fitted)   25.00 dB",
            True,
        ),
        ({"left_s": 31.0}, "31 s left", False),
    ],
)
def test_figures(capsys, figures, shown, guesses):
    """Catches a PSNR with fitted exposure that a person takes for the other one, and the bar's own
    guess beside the time left that the work says."""
    with ProgressBar() as bar:
        for share in (0.0, 0.5):
            bar.report(Progress(share, "Landmarks", figures=lambda: figures))
    written = capsys.readouterr().err
    assert shown in written
    assert ("<" in written) == guesses
